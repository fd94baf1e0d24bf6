"""Render Gaussians from all sides, with the depths that a surface is fused from."""

from typing import NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from ..gaussians.gaussians import Gaussians
from ..gaussians.views import EPS2D, FOVY, Views, rasterize_views, row_batches, views_around
from .fusion import DepthFusion
from .options import MeshOptions

SINES = (-0.9, 0.95)
"""Of the elevations of the first and the last view: undersides are looked at too."""
DISTANCE = 1.2
"""Of the views, relative to where the ball of 99 % of the opacity fills them; the rest is outside.
"""


class Renders(NamedTuple):
    """V renders of size x size pixels."""

    c2w: Float[np.ndarray, "V 4 4"]
    """OpenGL."""
    rgba: UInt8[np.ndarray, "V S S 4"]
    """Display colour, not multiplied by the opacity, and opacity."""
    fovy: float = FOVY
    """Radians."""


def render_around(cloud: Gaussians, options: MeshOptions, fusion: Optional[DepthFusion]) -> Renders:
    """Render a cloud (tensors, z up) from all sides, and add the depths to ``fusion``.

    Raises:
        UserError: the cloud is too large to be rendered in float32.
    """
    views = views_around(
        cloud, options.views, options.view_size, sines=SINES, distances=(DISTANCE,)
    )
    eps2d = EPS2D if options.eps2d is None else options.eps2d
    views = views._replace(eps2d=eps2d, antialias=bool(options.antialias))
    rgba = np.empty((options.views, views.size, views.size, 4), np.uint8)
    with tqdm(desc="surface", unit="view", total=options.views, disable=None, leave=False) as bar:
        for rows in row_batches(views, len(cloud.means)):
            rgba[rows] = _render(cloud, views, rows, fusion)
            bar.update(len(rows))
    return Renders(opengl(views), rgba)


@torch.no_grad()
def _render(
    cloud: Gaussians, views: Views, rows: Tensor, fusion: Optional[DepthFusion]
) -> UInt8[np.ndarray, "B S S 4"]:
    """Return the pictures of some of the views, after adding their depths to ``fusion``."""
    viewmats = views.viewmats[rows]
    # relative to the views' centre, since squares of large depths lose the digits of the deviation
    depths = torch.einsum("bj,nj->bn", viewmats[:, 2, :3], cloud.means - cloud.means.mean(0))
    black = torch.zeros(len(rows), 5, device=depths.device)
    moments = torch.stack([depths, depths.square()], dim=-1)
    out = rasterize_views(cloud, views, rows, black, channels=moments)
    colors, mean, square = (out.image / out.alpha.clamp_min(1e-6)).split([3, 1, 1], dim=-1)
    if fusion is not None:
        origin = (
            torch.einsum("bj,j->b", viewmats[:, 2, :3], cloud.means.mean(0)) + viewmats[:, 2, 3]
        )
        deviation = (square - mean.square()).clamp_min(0).sqrt()
        pictures = (mean + origin[:, None, None, None], deviation, out.alpha)
        for row, *maps in zip(rows, *pictures, strict=True):
            fusion.add(views.viewmats[row], views.Ks[row], *(values[..., 0] for values in maps))
    rgba = torch.cat([colors, out.alpha], dim=-1).clamp(0, 1)
    return (255 * rgba).round().byte().cpu().numpy()


def opengl(views: Views) -> Float[np.ndarray, "V 4 4"]:
    """Return the camera-to-world matrices of the views."""
    c2w = torch.zeros_like(views.viewmats)
    flip = torch.tensor([1.0, -1.0, -1.0], device=c2w.device)
    c2w[:, :3, :3] = views.viewmats[:, :3, :3].transpose(1, 2) * flip
    c2w[:, :3, 3], c2w[:, 3, 3] = views.positions, 1
    return c2w.double().cpu().numpy()
