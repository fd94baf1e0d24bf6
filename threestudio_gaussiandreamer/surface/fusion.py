"""Fuse rendered depths of Gaussians to a signed distance on a grid (Curless and Levoy 1996).

A render gives each pixel the mean and the standard deviation of the depths of its Gaussians,
weighted by their blending weights. The surface that a pixel shows is assumed to lie one standard
deviation in front of the mean, since Gaussians behind the surface contribute to the mean too. Each
view adds to a grid point the distance to that surface along the optical axis, truncated to ``BAND``
cells, weighted by the inverse variance of the depth. A view adds nothing to points that lie farther
behind its surface than ``HIDDEN`` bands.

A point that any view sees in front of mostly background is outside, whatever the depths say, so the
mesh has the outlines of the renders. Points that no view sees are inside, so the surface has no
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
"""Points farther than this behind a view's surface are hidden from the view, bands."""
FRONT = 1.0
"""Distance of the surface in front of the mean depth, standard deviations."""
MARGIN = 3
"""Cells that the grid adds on each side of the box."""
EMPTY = 0.999
"""A point whose emptiness, 1 - 2 alpha, reaches this in a view is outside for good."""


class DepthFusion:
    """A grid of signed distances in units of ``BAND`` cells, positive outside.

    Args:
        low, high: corners of the box that holds the Gaussians.
        resolution: cells along the longest side of the box.
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
        coordinates = _image_coordinates(points, K, alpha.shape)
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
        self._forget_empty()

    def field(self) -> Float[np.ndarray, "X Y Z"]:
        """Return the signed distances, in [-1, 1] bands; the grid's border is set to outside."""
        total, weight, empty = self._sums
        distance = torch.where(weight > 0, total / weight.clamp_min(1e-12), -1)
        values = torch.ones(self.shape, device=total.device)
        values[tuple(self._undecided.T)] = torch.maximum(distance, empty)
        closed = torch.ones_like(values)
        closed[1:-1, 1:-1, 1:-1] = values[1:-1, 1:-1, 1:-1]
        return closed.cpu().numpy()

    def _forget_empty(self) -> None:
        """Drop the empty points from the sums when they are more than a tenth."""
        keep = self._sums[2] < EMPTY
        if keep.float().mean() < 0.9:
            self._undecided, self._sums = self._undecided[keep], self._sums[:, keep]


def _image_coordinates(
    points: Float[Tensor, "P 3"], K: Float[Tensor, "3 3"], size: torch.Size
) -> Float[Tensor, "P 2"]:
    """Project points in camera coordinates to (x, y), -1 and 1 at the edges of the image."""
    ends = torch.tensor([size[1], size[0]], device=points.device)
    pixels = points[:, :2] / points[:, 2:].clamp_min(1e-9) * K[[0, 1], [0, 1]] + K[:2, 2]
    return 2 * pixels / ends - 1
