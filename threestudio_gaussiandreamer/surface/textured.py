"""Convert Gaussians to a closed triangle mesh with a texture.

=============  ===================================================================================
option         meaning
=============  ===================================================================================
faces          largest number of triangles
texture        width and height of the texture, texels
method         ``fusion`` of rendered depths, or a level set of the summed ``density``
resolution     cells along the longest side of the grid that the surface is extracted from
views          number of renders, on a sphere around the cloud, for depths and colours
view_size      width and height of a render, pixels
eps2d          screen-space dilation of the renders, square pixels; null: the run's, or 0.3
antialias      whether the renders are antialiased; null: as in the run, or not
=============  ===================================================================================
"""

from dataclasses import dataclass, field
from typing import Optional

import numpy as np

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.logs import warn
from ..core.options import at_least, check_options, in_range, one_of, require_memory
from ..gaussians.gaussians import Gaussians, finite, opaque
from ..gaussians.surface import MIN_OPACITY, gaussian_surface
from ..gaussians.views import EPS2D, views_around
from ..meshes.mesh import Mesh
from .bake import bake, faces_that_fit, unwrap
from .closed import simplified, without_small_parts
from .fusion import DepthFusion, render

METHODS = ("fusion", "density")
MIN_COMPONENT = 0.01
"""Connected parts with a smaller share of the surface's area than this are dropped."""
SINES = (-0.9, 0.95)
"""Of the elevations of the first and the last view: undersides are looked at too."""
DISTANCE = 1.2
"""Of the views, relative to where the ball of 99 % of the opacity fills them."""


@dataclass
class MeshOptions:
    """Size of the mesh and of its texture, and the renders of the cloud that both are made from."""

    faces: int = field(default=5000, metadata=in_range(100, 100_000, "triangles"))
    texture: int = field(default=1024, metadata=in_range(64, 8192, "texels each way"))
    method: str = field(default="fusion", metadata=one_of(METHODS))
    resolution: int = field(default=144, metadata=in_range(16, 256, "cells"))
    views: int = field(default=64, metadata=in_range(8, 1024, "renders"))
    view_size: int = field(default=512, metadata=in_range(64, 2048, "pixels each way"))
    eps2d: Optional[float] = field(default=None, metadata=at_least(0, "square pixels"))
    antialias: Optional[bool] = None

    REMOVED = {"min_component": (MIN_COMPONENT, f"it is {MIN_COMPONENT}")}

    @staticmethod
    def check(cfg: "MeshOptions") -> None:
        """Raise UserError unless the texture has room for the faces, and all fits into memory."""
        fit = faces_that_fit(cfg.texture)
        if cfg.faces > fit:
            raise UserError(
                f"faces: a texture of {cfg.texture} x {cfg.texture} texels has room for {fit} "
                f"faces, not {cfg.faces}; take fewer faces or a larger texture"
            )
        pictures = f"{cfg.views} renders of {cfg.view_size} x {cfg.view_size} pixels"
        # a pixel has colour, opacity, and one byte of work; a texel sums of colours and of weights
        require_memory("view_size", 5 * cfg.views * cfg.view_size**2, pictures)
        texels = f"a texture of {cfg.texture} x {cfg.texture} texels"
        require_memory("texture", 150 * cfg.texture**2, texels)


def require_mesh_libraries() -> None:
    """Raise UserError, with the command that installs them, unless the libraries are there."""
    require_extra("mesh", "skimage", "fast_simplification", "xatlas")


def mesh_from_gaussians(
    gaussians: Gaussians, options: Optional[MeshOptions] = None, where: str = ""
) -> Mesh:
    """Convert Gaussians to a closed mesh with ``uv`` and ``texture``, in the same units and axes.

    Vertices are repeated at the texture's seams, at exactly the same position.

    Args:
        gaussians: in the world's axes, z up; those that can't be drawn are skipped with a warning.
        where: the prefix of options' names in messages.

    Raises:
        UserError: a library of the extra ``mesh`` is missing, an option is invalid, or the
            Gaussians form no surface.
    """
    options = MeshOptions() if options is None else options
    check_options(MeshOptions, options, where)
    require_mesh_libraries()
    whole_cloud = finite(gaussians.arrays(), "mesh")
    gaussians = whole_cloud.rows(opaque(whole_cloud, MIN_OPACITY))
    if not len(gaussians.means):
        raise _no_surface(whole_cloud)
    cloud, fusion = gaussians.tensors(), None
    if options.method == "fusion":
        reach = cloud.log_scales.exp().amax(dim=1, keepdim=True)  # one deviation
        low, high = (cloud.means - reach).amin(dim=0), (cloud.means + reach).amax(dim=0)
        fusion = DepthFusion(low, high, options.resolution)
    count, size = options.views, options.view_size
    views = views_around(cloud, count, size, sines=SINES, distances=(DISTANCE,))
    eps2d = EPS2D if options.eps2d is None else options.eps2d
    renders = render(cloud, views._replace(eps2d=eps2d, antialias=bool(options.antialias)), fusion)
    if fusion is None:
        vertices, faces, *_ = gaussian_surface(gaussians, resolution=options.resolution)
    else:
        from skimage.measure import marching_cubes

        vertices, faces, distances = np.zeros((0, 3)), np.zeros((0, 3), np.int64), fusion.field()
        if (distances < 0).any():  # with all its parts, normals outwards
            vertices, faces, *_ = marching_cubes(distances, 0.0, gradient_direction="ascent")
            vertices = vertices * fusion.cell + fusion.origin.double().cpu().numpy()
            faces = faces[:, ::-1].astype(np.int64)
    vertices, faces, specks = without_small_parts(vertices, faces, MIN_COMPONENT)
    if not len(faces):
        raise _no_surface(gaussians)
    # simplification cuts through thin parts and opens cavities, so there are small ones again
    vertices, faces, tips = without_small_parts(
        *simplified(vertices, faces, options.faces), MIN_COMPONENT
    )
    if loose := specks + tips:
        warn(f"mesh: {loose} loose parts below {MIN_COMPONENT:.2%} of the area are left out")
    atlas = unwrap(vertices, faces, options.texture)
    mesh = Mesh(vertices[atlas.rows], atlas.faces, uv=atlas.uv)
    return mesh._replace(texture=bake(mesh, renders, options.texture))


def _no_surface(gaussians: Gaussians) -> UserError:
    visible, count = int(opaque(gaussians, MIN_OPACITY).sum()), len(gaussians.means)
    return UserError(
        "the Gaussians form no surface: no view is covered to more than half; of "
        f"{count} Gaussians {visible} have an opacity of {MIN_OPACITY} or more"
    )
