"""Lists of the splats that may reach a pixel of each screen tile, front to back, in bounded memory;
in torch, on any device.

The tiles of all views form one grid, with the views stacked vertically, so that one pass processes
the batch.
"""

from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor

TILE = 8
CANDIDATES_PER_SLICE = 2**22
CANDIDATES_PER_TEST = 2**17
# Margin for the rounding of the float32 tests. The blend evaluates each pixel exactly, so an
# unnecessarily listed splat only costs time.
SLACK = 1e-3


class Grid(NamedTuple):
    """Tiles of ``views`` images, numbered row by row."""

    views: int
    rows: int  # of one view
    columns: int

    @property
    def tiles(self) -> int:
        return self.views * self.rows * self.columns

    def origins(self, tiles: Tensor) -> tuple[Tensor, Tensor]:
        """Return x and y (G,) of the upper left corners, in pixels of each tile's own view."""
        return tiles % self.columns * TILE, tiles // self.columns % self.rows * TILE


class Bounds(NamedTuple):
    """Data of S splats, front to back, that the overlap tests need."""

    # (6, S): mean x, y in pixels of the view; conic a, k, c; the largest q at which alpha >=
    # alpha_min
    shapes: Tensor
    # (4, S): left, top, right, bottom in tiles of the grid, the last two exclusive
    rectangles: Tensor
    first_rows: Tensor  # (S,) the row of the grid where the splat's view starts


class Lists(NamedTuple):
    """Lists of splats: that of ``tiles[i]`` is ``splats[starts[i] : starts[i] + counts[i]]``, front
    to back; the longest list is first.
    """

    tiles: Tensor
    starts: Tensor
    counts: Tensor
    splats: Tensor


def make_grid(views: int, width: int, height: int) -> Grid:
    return Grid(views, -(-height // TILE), -(-width // TILE))


def bound(means2d, conics, opacities, extents, views, grid: Grid, alpha_min: float) -> Bounds:
    """Compute the rectangle of tiles around alpha >= alpha_min for each splat; ``views`` (S,) are
    the indices of their views.
    """
    limit = means2d.new_tensor([grid.columns, grid.rows])
    extents = extents * (1 + SLACK) + SLACK
    low = torch.minimum(((means2d - extents - 0.5) / TILE).floor().clamp(min=0), limit)
    high = torch.minimum(((means2d + extents - 0.5) / TILE).floor() + 1, limit).clamp(min=0)
    first_rows = views * grid.rows
    shift = torch.stack([torch.zeros_like(views), first_rows])
    levels = torch.full_like(opacities, torch.inf)
    if alpha_min > 0:
        levels = 2 * torch.log(opacities / alpha_min)
    shapes = torch.cat([means2d.t(), conics.t(), levels[None] * (1 + SLACK) + SLACK])
    return Bounds(shapes, torch.cat([low.t().long() + shift, high.t().long() + shift]), first_rows)


def slices(bounds: Bounds) -> list[tuple[int, int]]:
    """Split the splats, front to back, into ranges (first, last + 1) with a bounded number of
    candidate tiles each.
    """
    size = bounds.rectangles[2:] - bounds.rectangles[:2]
    part = size.clamp(min=0).prod(0).cumsum(0) // CANDIDATES_PER_SLICE
    ends = part.unique_consecutive(return_counts=True)[1].cumsum(0).tolist()
    return list(pairwise([0, *ends]))


def list_splats(bounds: Bounds, first: int, last: int, unfinished: Tensor, grid: Grid) -> Lists:
    """List the splats ``first`` to ``last - 1`` for each tile of which they reach a pixel centre.

    Args:
        unfinished: (tiles,) bool; other tiles get no list.
    """
    left, top, right, bottom = bounds.rectangles[:, first:last]
    width, height = (right - left).clamp(min=0), (bottom - top).clamp(min=0)
    counts = width * height
    firsts = counts.cumsum(0) - counts
    boxes = torch.stack([left, top, width, firsts, bounds.first_rows[first:last]])
    splats = torch.repeat_interleave(torch.arange(last - first, device=counts.device), counts)
    shapes, parts = bounds.shapes[:, first:last], splats.split(CANDIDATES_PER_TEST)
    pairs = [
        _test(shapes, boxes, part, i * CANDIDATES_PER_TEST, unfinished, grid)
        for i, part in enumerate(parts)
    ]
    tiles, splats = (torch.cat(x) for x in zip(*pairs, strict=True))
    tiles, order = tiles.sort(stable=True)
    return _longest_first(*tiles.unique_consecutive(return_counts=True), splats[order] + first)


def _test(
    shapes: Tensor, boxes: Tensor, splats: Tensor, first: int, unfinished: Tensor, grid: Grid
) -> tuple[Tensor, Tensor]:
    """Return tiles and splats of those candidates that pass :func:`_reaches`; candidates are
    numbered from ``first``.
    """
    left, top, width, first_candidate, first_row = boxes.index_select(1, splats)
    within = torch.arange(first, first + len(splats), device=splats.device) - first_candidate
    row = torch.div(within, width, rounding_mode="floor")
    column, row = left + within - row * width, top + row
    tiles = row * grid.columns + column
    corner = column * TILE + 0.5, (row - first_row) * TILE + 0.5
    reached = _reaches(shapes.index_select(1, splats), *corner)
    kept = (reached & unfinished.index_select(0, tiles)).nonzero()[:, 0]
    return tiles[kept].int(), splats[kept].int()


def _reaches(shapes, left, top) -> Tensor:
    """Return whether the minimum of ``q = a (d.x - k d.y)^2 + c d.y^2`` over the box of the tile's
    pixel centres is at most the splat's level.

    Unless the splat's centre is inside the box, the minimum of the convex q lies on one of the two
    sides nearest to that centre. On a side the other coordinate has a closed-form optimum:
    ``d.x = k d.y`` for given d.y, and ``d.y = d.x a k / (a k^2 + c)`` for given d.x."""
    mean_x, mean_y, a, k, c, level = shapes
    x0, y0 = left - mean_x, top - mean_y
    x1, y1 = x0 + (TILE - 1), y0 + (TILE - 1)
    x, y = torch.clamp(torch.zeros_like(x0), x0, x1), torch.clamp(torch.zeros_like(y0), y0, y1)
    other_x = torch.clamp(k * y, x0, x1)
    other_y = torch.clamp(x * (a * k / (a * k * k + c)), y0, y1)
    on_row = a * (other_x - k * y) ** 2 + c * y**2
    on_column = a * (x - k * other_y) ** 2 + c * other_y**2
    return torch.minimum(on_row, on_column) <= level


def _longest_first(tiles: Tensor, counts: Tensor, splats: Tensor) -> Lists:
    starts = counts.cumsum(0) - counts
    order = counts.argsort(descending=True, stable=True)
    return Lists(tiles[order].long(), starts[order], counts[order], splats)
