"""Fuse rendered depths of Gaussians to a signed distance on a grid (Curless and Levoy 1996).

A render gives each pixel the mean and the standard deviation of the depths of its Gaussians,
weighted as their colours are. The surface that a pixel shows is taken to lie one deviation before
the mean: the layers behind it show through. Each view adds to a grid point the distance to that
surface along the optical axis, truncated to ``BAND`` cells, weighted by the inverse variance of the
depth. Points that are farther behind the surface are hidden from the view, which says nothing about
them.

A point is outside, whatever the depths say, where a view sees mostly background: the outlines of
the mesh are those of the renders. Points that no view sees are inside, so the surface has no
holes."""

import math

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

BAND = 3.0
"""Distance at which the signed distance is truncated, cells."""
HIDDEN = 3.0
"""Points this many bands behind a surface are hidden by it."""
FRONT = 1.0
"""Standard deviations by which the surface lies before the mean depth."""
MARGIN = 3
"""Cells around the box, all of them outside."""
EMPTY = 0.999
"""A point that a view shows to be empty by this much isn't looked at again."""


class DepthFusion:
    """A grid of signed distances, in bands, positive outside."""

    def __init__(self, low: Float[Tensor, "3"], high: Float[Tensor, "3"], resolution: int) -> None:
        self.cell = max(float((high - low).max()) / resolution, 1e-9)
        self.origin = low - MARGIN * self.cell
        self.shape = [math.ceil(float(side) / self.cell) + 2 * MARGIN + 1 for side in high - low]
        axes = [torch.arange(count, device=low.device) for count in self.shape]
        self._undecided = torch.cartesian_prod(*axes)
        self._sums = torch.zeros(3, len(self._undecided), device=low.device)
        """Weighted distances, weights, and how clearly a view has shown the point to be empty."""
        self._sums[2] = -1

    def add(
        self,
        viewmat: Float[Tensor, "4 4"],
        K: Float[Tensor, "3 3"],
        depth: Float[Tensor, "H W"],
        deviation: Float[Tensor, "H W"],
        alpha: Float[Tensor, "H W"],
    ) -> None:
        """Add a view: its OpenCV camera, and the mean and deviation of depth and the opacity."""
        weight = alpha / (deviation.square() + (0.5 * self.cell) ** 2)
        # depths of different surfaces are averaged by their weights, as the pixels' colours are
        maps = torch.stack([(depth - FRONT * deviation) * weight, weight, alpha])
        points = (self._undecided * self.cell + self.origin) @ viewmat[:3, :3].T + viewmat[:3, 3]
        places = _pixels(points, K, alpha.shape)
        near, weight, alpha = F.grid_sample(
            maps[None], places[None, None], padding_mode="border", align_corners=False
        )[0, :, 0]
        distance = (near / weight.clamp_min(1e-12) - points[:, 2]) / (BAND * self.cell)
        framed = (places.abs() <= 1).all(1) & (points[:, 2] > 0)
        seen = framed & (alpha > 0.5) & (distance > -HIDDEN)
        weight = weight * seen
        self._sums[0] += weight * distance.clamp(-1, 1)
        self._sums[1] += weight
        self._sums[2] = torch.maximum(self._sums[2], torch.where(framed, 1 - 2 * alpha, -1))
        self._forget_empty()

    def field(self) -> Float[np.ndarray, "X Y Z"]:
        """Return the signed distances, in [-1, 1] bands; the border of the grid is outside."""
        total, weight, empty = self._sums
        distance = torch.where(weight > 0, total / weight.clamp_min(1e-12), -1)
        values = torch.ones(self.shape, device=total.device)
        values[tuple(self._undecided.T)] = torch.maximum(distance, empty)
        closed = torch.ones_like(values)
        closed[1:-1, 1:-1, 1:-1] = values[1:-1, 1:-1, 1:-1]
        return closed.cpu().numpy()

    def _forget_empty(self) -> None:
        """Drop the points that the last view has shown to be empty, once they are many."""
        keep = self._sums[2] < EMPTY
        if keep.float().mean() < 0.9:
            self._undecided, self._sums = self._undecided[keep], self._sums[:, keep]


def _pixels(
    points: Float[Tensor, "P 3"], K: Float[Tensor, "3 3"], size: torch.Size
) -> Float[Tensor, "P 2"]:
    """Project points in camera coordinates to (x, y), -1 and 1 at the edges of the image."""
    ends = torch.tensor([size[1], size[0]], device=points.device)
    pixels = points[:, :2] / points[:, 2:].clamp_min(1e-9) * K[[0, 1], [0, 1]] + K[:2, 2]
    return 2 * pixels / ends - 1
