"""Which splats may touch which tile of the screen, front to back, in bounded memory; torch on any device.

The tiles of all views form one grid, views stacked from top to bottom, so one pass serves a batch.
"""

from typing import NamedTuple

import torch
from torch import Tensor

TILE = 8
CANDIDATES_PER_REGION = 2**22
CANDIDATES_PER_TEST = 2**17
# Widens the bounds of the float32 tests; the blend decides each pixel exactly, so a splat too many costs time only.
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
        """x and y (G,) of the upper left corners, in pixels of the tiles' own view."""
        return tiles % self.columns * TILE, tiles // self.columns % self.rows * TILE


class Region(NamedTuple):
    """A rectangle of the grid: columns left to right-1, rows top to bottom-1."""

    left: int
    top: int
    right: int
    bottom: int


class Bounds(NamedTuple):
    """S splats in their order, with what the tests need."""

    shapes: Tensor  # (6, S): mean x, y in pixels of the view; conic a, k, c; the largest q at which alpha >= alpha_min
    rectangles: Tensor  # (4, S): left, top, right, bottom in tiles of the grid, the last two exclusive
    first_rows: Tensor  # (S,) the row of the grid where the splat's view starts


class Lists(NamedTuple):
    """The splats of each tile: tile i has ``splats[starts[i] : starts[i] + counts[i]]``, front to back; longest list first."""

    tiles: Tensor
    starts: Tensor
    counts: Tensor
    splats: Tensor


def make_grid(views: int, width: int, height: int) -> Grid:
    return Grid(views, -(-height // TILE), -(-width // TILE))


def bound(means2d, conics, opacities, extents, views, grid: Grid, alpha_min: float) -> Bounds:
    """Tile rectangles around alpha >= alpha_min; ``views`` (S,) says which image a splat belongs to."""
    limit = means2d.new_tensor([grid.columns, grid.rows])
    extents = extents * (1 + SLACK) + SLACK
    low = torch.minimum(((means2d - extents - 0.5) / TILE).floor().clamp(min=0), limit)
    high = torch.minimum(((means2d + extents - 0.5) / TILE).floor() + 1, limit).clamp(min=0)
    first_rows = views * grid.rows
    shift = torch.stack([torch.zeros_like(views), first_rows])
    levels = 2 * torch.log(opacities / alpha_min) if alpha_min > 0 else torch.full_like(opacities, torch.inf)
    shapes = torch.cat([means2d.t(), conics.t(), levels[None] * (1 + SLACK) + SLACK])
    return Bounds(shapes, torch.cat([low.t().long() + shift, high.t().long() + shift]), first_rows)


def regions(bounds: Bounds, grid: Grid) -> list[Region]:
    """The grid cut in halves until each part has few enough candidates, or is one tile."""
    counts = _candidates_per_tile(bounds.rectangles, grid).cpu()
    pending, done = [Region(0, 0, grid.columns, grid.views * grid.rows)], []
    while pending:
        region = pending.pop()
        columns, rows = region.right - region.left, region.bottom - region.top
        total = counts[region.top : region.bottom, region.left : region.right].sum()
        if total <= CANDIDATES_PER_REGION or columns * rows == 1:
            done.append(region)
        elif rows >= columns:
            middle = region.top + rows // 2
            pending += [region._replace(top=middle), region._replace(bottom=middle)]
        else:
            middle = region.left + columns // 2
            pending += [region._replace(left=middle), region._replace(right=middle)]
    return done


def list_splats(bounds: Bounds, region: Region, grid: Grid) -> Lists:
    """Every pair of splat and tile in the region whose splat reaches a pixel centre of the tile, sorted by tile."""
    rectangles, region = bounds.rectangles, bounds.rectangles.new_tensor(region)[:, None]
    low = torch.maximum(rectangles[:2], region[:2])
    width, height = (torch.minimum(rectangles[2:], region[2:]) - low).clamp(min=0)
    counts = width * height
    boxes = torch.stack([*low, width, counts.cumsum(0) - counts, bounds.first_rows])
    splats = torch.repeat_interleave(torch.arange(len(counts), device=counts.device), counts)
    parts = [_test(bounds, boxes, part, i * CANDIDATES_PER_TEST, grid) for i, part in enumerate(splats.split(CANDIDATES_PER_TEST))]
    tiles, splats = (torch.cat(x) for x in zip(*parts))
    tiles, order = tiles.sort(stable=True)
    return _longest_first(*tiles.unique_consecutive(return_counts=True), splats[order])


def _candidates_per_tile(rectangles: Tensor, grid: Grid) -> Tensor:
    """How many rectangles cover each tile: corners of a second difference, summed up twice."""
    width = grid.columns + 1
    corners = rectangles.new_zeros((grid.views * grid.rows + 1) * width)
    left, top, right, bottom = rectangles
    filled = ((right > left) & (bottom > top)).long()
    for row, column, sign in ((top, left, 1), (top, right, -1), (bottom, left, -1), (bottom, right, 1)):
        corners.index_add_(0, row * width + column, sign * filled)
    return corners.view(-1, width).cumsum(0).cumsum(1)[:-1, :-1]


def _test(bounds: Bounds, boxes: Tensor, splats: Tensor, first: int, grid: Grid) -> tuple[Tensor, Tensor]:
    """Tiles and splats of the candidates ``first``, ``first + 1``, ... that pass the exact test."""
    left, top, width, first_candidate, first_row = boxes.index_select(1, splats)
    within = torch.arange(first, first + len(splats), device=splats.device) - first_candidate
    row = torch.div(within, width, rounding_mode="floor")
    column, row = left + within - row * width, top + row
    reached = _reaches(bounds.shapes.index_select(1, splats), column * TILE + 0.5, (row - first_row) * TILE + 0.5).nonzero()[:, 0]
    return (row * grid.columns + column)[reached].int(), splats[reached].int()


def _reaches(shapes, left, top) -> Tensor:
    """Whether ``q = a (d.x - k d.y)^2 + c d.y^2`` gets as low as the splat's level on the box of the tile's pixel centres.

    The minimum of a convex q over a box lies, unless the centre is inside, on the box's sides nearest to the centre, where
    the other coordinate has its closed-form optimum: ``d.x = k d.y`` for given d.y; for given d.x,
    ``d.y = d.x a k / (a k^2 + c)``.
    """
    mean_x, mean_y, a, k, c, level = shapes
    x0, y0 = left - mean_x, top - mean_y
    x1, y1 = x0 + (TILE - 1), y0 + (TILE - 1)
    x, y = torch.clamp(torch.zeros_like(x0), x0, x1), torch.clamp(torch.zeros_like(y0), y0, y1)
    other_x = torch.clamp(k * y, x0, x1)
    other_y = torch.clamp(x * (a * k / (a * k * k + c)), y0, y1)
    q = torch.minimum(a * (other_x - k * y) ** 2 + c * y**2, a * (x - k * other_y) ** 2 + c * other_y**2)
    return q <= level


def _longest_first(tiles: Tensor, counts: Tensor, splats: Tensor) -> Lists:
    starts = counts.cumsum(0) - counts
    order = counts.argsort(descending=True, stable=True)
    return Lists(tiles[order].long(), starts[order], counts[order], splats)
