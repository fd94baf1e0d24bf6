"""Convert Gaussians to a closed triangle mesh with a texture."""

from typing import Optional

import numpy as np
import torch
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.logs import warn
from ..core.options import check_options
from ..gaussians.gaussians import Gaussians, finite, opaque
from ..gaussians.surface import MIN_OPACITY, gaussian_surface
from ..meshes.mesh import Mesh
from .bake import bake
from .closed import simplified, without_small_parts
from .fusion import DepthFusion
from .options import MeshOptions
from .renders import render_around
from .unwrap import unwrap

NO_SURFACE = (
    "the Gaussians form no surface: no view is covered to more than half; of {count} Gaussians "
    "{visible} have an opacity of {least} or more"
)


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
    gaussians = _visible(finite(gaussians.arrays(), "mesh"))
    cloud = gaussians.tensors()
    fusion = DepthFusion(*_box(cloud), options.resolution) if options.method == "fusion" else None
    renders = render_around(cloud, options, fusion)
    vertices, faces = _extracted(gaussians, fusion, options)
    vertices, faces, specks = without_small_parts(vertices, faces, options.min_component)
    if not len(faces):
        raise _no_surface(gaussians)
    # simplification cuts through thin parts and opens cavities, so there are small ones again
    vertices, faces, tips = without_small_parts(
        *simplified(vertices, faces, options.faces), options.min_component
    )
    if specks + tips:
        share = f"{options.min_component:.2%}"
        warn(f"mesh: {specks + tips} loose parts below {share} of the area are left out")
    atlas = unwrap(vertices, faces, options.texture)
    mesh = Mesh(vertices[atlas.rows], atlas.faces, uv=atlas.uv)
    return mesh._replace(texture=bake(mesh, renders, options.texture))


def _visible(gaussians: Gaussians) -> Gaussians:
    """Drop Gaussians that are too faint to be seen.

    Raises:
        UserError: all are, or there are none.
    """
    visible = opaque(gaussians, MIN_OPACITY)
    if not visible.any():
        raise _no_surface(gaussians)
    return gaussians.rows(visible)


def _no_surface(gaussians: Gaussians) -> UserError:
    visible = int(opaque(gaussians, MIN_OPACITY).sum())
    count = len(gaussians.means)
    return UserError(NO_SURFACE.format(count=count, visible=visible, least=MIN_OPACITY))


def _box(cloud: Gaussians) -> tuple[Float[torch.Tensor, "3"], Float[torch.Tensor, "3"]]:
    """Return the lowest and the highest corner of the Gaussians' box, to one deviation."""
    reach = cloud.log_scales.exp().amax(dim=1, keepdim=True)
    return (cloud.means - reach).amin(dim=0), (cloud.means + reach).amax(dim=0)


def _extracted(
    gaussians: Gaussians, fusion: Optional[DepthFusion], options: MeshOptions
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return the closed surface with all its parts, normals outwards; empty where there is none."""
    if fusion is None:
        surface = gaussian_surface(gaussians, resolution=options.resolution)
        return surface.vertices, surface.faces
    from skimage.measure import marching_cubes

    field = fusion.field()
    if not (field < 0).any():
        return np.zeros((0, 3)), np.zeros((0, 3), np.int64)
    vertices, faces, _, _ = marching_cubes(field, 0.0, gradient_direction="ascent")
    origin = fusion.origin.double().cpu().numpy()
    return vertices * fusion.cell + origin, faces[:, ::-1].astype(np.int64)
