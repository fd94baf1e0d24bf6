"""Render Gaussians from all sides, fuse depths to signed distances on a grid (Curless, Levoy 1996).

The surface that a pixel shows is assumed to lie one standard deviation in front of the mean depth,
since Gaussians behind the surface contribute to the mean too. Each view adds to a grid point the
distance to that surface along the optical axis, truncated to ``BAND`` cells, weighted by the
inverse variance of the depth, but nothing to points farther behind it than ``HIDDEN`` bands.

A point that any view sees in front of mostly background is outside, so the mesh has the outlines of
the renders. Points that no view sees are inside, so the surface has no holes."""

import math
from typing import NamedTuple, Optional

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor
from tqdm import tqdm

from ..gaussians.gaussians import Gaussians
from ..gaussians.views import FOVY, Views, rasterize_views, row_batches

BAND = 3.0
"""Distance at which the signed distance is truncated, cells."""
HIDDEN = 3.0
"""Points farther than this behind a view's surface are hidden from the view, bands."""
FRONT = 1.0
"""Distance of the surface in front of the mean depth, standard deviations."""
MARGIN = 3
"""Cells that the grid adds on each side of the box."""
EMPTY = 0.999
"""A point whose emptiness, 1 - 2 alpha, reaches this in a view is outside for good."""


class DepthFusion:
    """A grid of signed distances in units of ``BAND`` cells, positive outside, around the box from
    ``low`` to ``high``, whose longest side has ``resolution`` cells.
    """

    def __init__(self, low: Float[Tensor, "3"], high: Float[Tensor, "3"], resolution: int) -> None:
        self.cell = max(float((high - low).max()) / resolution, 1e-9)
        self.origin = low - MARGIN * self.cell
        self.shape = [math.ceil(float(side) / self.cell) + 2 * MARGIN + 1 for side in high - low]
        axes = [torch.arange(count, device=low.device) for count in self.shape]
        self._undecided = torch.cartesian_prod(*axes)
        self._sums = torch.zeros(3, len(self._undecided), device=low.device)
        """Sums of weighted distances and of weights, and the largest emptiness in a view."""
        self._sums[2] = -1

    def add(
        self,
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        depth: Float[Tensor, "H W"],
        deviation: Float[Tensor, "H W"],
        alpha: Float[Tensor, "H W"],
    ) -> None:
        """Add a view: its OpenCV camera, mean and standard deviation of depth, and opacity."""
        weight = alpha / (deviation.square() + (0.5 * self.cell) ** 2)
        # interpolate weighted depths, so that uncertain pixels count less than their neighbours
        maps = torch.stack([(depth - FRONT * deviation) * weight, weight, alpha])
        points = (self._undecided * self.cell + self.origin) @ viewmat[:3, :3].T + viewmat[:3, 3]
        ends = torch.tensor([alpha.shape[1], alpha.shape[0]], device=points.device)
        pixels = points[:, :2] / points[:, 2:].clamp_min(1e-9) * K[[0, 1], [0, 1]] + K[:2, 2]
        coordinates = 2 * pixels / ends - 1  # -1 and 1 at the edges of the image
        weighted_depth, weight, alpha = F.grid_sample(
            maps[None], coordinates[None, None], padding_mode="border", align_corners=False
        )[0, :, 0]
        distance = (weighted_depth / weight.clamp_min(1e-12) - points[:, 2]) / (BAND * self.cell)
        in_image = (coordinates.abs() <= 1).all(1) & (points[:, 2] > 0)
        seen = in_image & (alpha > 0.5) & (distance > -HIDDEN)
        weight = weight * seen
        self._sums[0] += weight * distance.clamp(-1, 1)
        self._sums[1] += weight
        self._sums[2] = torch.maximum(self._sums[2], torch.where(in_image, 1 - 2 * alpha, -1))
        keep = self._sums[2] < EMPTY
        if keep.float().mean() < 0.9:
            self._undecided, self._sums = self._undecided[keep], self._sums[:, keep]

    def field(self) -> Float[np.ndarray, "X Y Z"]:
        """Return the signed distances, in [-1, 1] bands; the grid's border is set to outside."""
        total, weight, empty = self._sums
        distance = torch.where(weight > 0, total / weight.clamp_min(1e-12), -1)
        values = torch.ones(self.shape, device=total.device)
        values[tuple(self._undecided.T)] = torch.maximum(distance, empty)
        return F.pad(values[1:-1, 1:-1, 1:-1], (1,) * 6, value=1.0).cpu().numpy()


class Renders(NamedTuple):
    """V renders of size x size pixels."""

    c2w: Float[np.ndarray, "V 4 4"]
    """OpenGL."""
    rgba: UInt8[np.ndarray, "V S S 4"]
    """Display colour, not multiplied by the opacity, and opacity."""
    fovy: float = FOVY
    """Radians."""


@torch.no_grad()
def render(cloud: Gaussians, views: Views, fusion: Optional[DepthFusion]) -> Renders:
    """Render views of a cloud (tensors), and add the depths to ``fusion``."""
    count, middle = len(views.viewmats), cloud.means.mean(0)
    rgba = np.empty((count, views.size, views.size, 4), np.uint8)
    with tqdm(desc="surface", unit="view", total=count, disable=None, leave=False) as bar:
        for rows in row_batches(views, len(cloud.means)):
            viewmats = views.viewmats[rows]
            # relative to the cloud's middle: squares of large depths lose the deviation's digits
            depths = torch.einsum("bj,nj->bn", viewmats[:, 2, :3], cloud.means - middle)
            black = torch.zeros(len(rows), 5, device=depths.device)
            moments = torch.stack([depths, depths.square()], dim=-1)
            out = rasterize_views(cloud, views, rows, black, channels=moments)
            colors, mean, square = (out.image / out.alpha.clamp_min(1e-6)).split([3, 1, 1], dim=-1)
            if fusion is not None:
                origin = torch.einsum("bj,j->b", viewmats[:, 2, :3], middle) + viewmats[:, 2, 3]
                deviation = (square - mean.square()).clamp_min(0).sqrt()
                pictures = (mean + origin[:, None, None, None], deviation, out.alpha)
                for row, *maps in zip(rows, *pictures, strict=True):
                    maps = (values[..., 0] for values in maps)
                    fusion.add(views.viewmats[row], views.Ks[row], *maps)
            picture = torch.cat([colors, out.alpha], dim=-1).clamp(0, 1)
            rgba[rows] = (255 * picture).round().byte().cpu().numpy()
            bar.update(len(rows))
    return Renders(opengl(views), rgba)


def opengl(views: Views) -> Float[np.ndarray, "V 4 4"]:
    """Return the camera-to-world matrices of the views."""
    flip = np.array([1.0, -1, -1, 1])
    return np.linalg.inv(views.viewmats.double().cpu().numpy()) * flip
