"""The image model in plain torch, exact and in bounded memory, for machines without a compiled
kernel; any device.

Each tile of 8 x 8 pixels has a list of splats. All tiles process their lists simultaneously, 64
splats per step, in blocks (tiles, pixels, splats) of bounded size; a tile is removed when its list
ends or its pixels are finished. Backward proceeds in the same order and recomputes the blocks, so
no tensor of size pixels x splats is stored. Lists are made for one slice of the splats at a time,
front to back, which bounds their size too.

On a CPU the results, except for gradients of the cameras, are bitwise identical for any number of
threads.
"""

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad, threshold, threshold_
from torch.utils.checkpoint import checkpoint

from ..core.devices import without_autocast
from .projection import Splats, project
from .reference import compose, track_means2d
from .scene import Rasterized, RasterizeOptions, Scene

TILE = 8
PIXELS = TILE * TILE
CANDIDATES_PER_SLICE = 2**22
CANDIDATES_PER_TEST = 2**17
# Margin for the rounding of the float32 tests. The blend evaluates each pixel exactly, so an
# unnecessarily listed splat only costs time.
SLACK = 1e-3
FAINTEST = 1e-30
SPLATS_PER_STEP = 64
ELEMENTS_PER_BLOCK = 2**20
KEPT_SLICES = 4
PROJECTED_AT_ONCE = 2**18
SHAPE_COLUMNS = 6
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    splats = _project(scene, options)
    tracked = (scene.colors, scene.background)
    splats = splats._replace(means2d=track_means2d(splats, tracked, options.absgrad))
    absgrad = getattr(splats.means2d, "absgrad", None)
    sums, contribution = _Blend.apply(scene.colors, absgrad, scene.size, options, *splats)
    return compose(sums, splats, contribution, scene.background, options)


def _project(scene: Scene, options: RasterizeOptions) -> Splats:
    """Call `project`, for many Gaussians in parts that backward recomputes, to save memory."""
    size = max(1, PROJECTED_AT_ONCE // len(scene.viewmats))
    if len(scene.means) <= size:
        return project(scene, options)
    gaussians = (*scene[:4], scene.colors)
    split = (x.split(size, -1 if x.dim() == 1 else -2) for x in gaussians)
    again, projected = {"use_reentrant": False, "preserve_rng_state": False}, []
    for part in zip(*split, strict=True):
        some = scene._replace(**dict(zip(GAUSSIANS, part, strict=True)))
        projected.append(checkpoint(project, some, options, **again))
    return Splats(*(torch.cat(x, 1) for x in zip(*projected, strict=True)))


class Grid(NamedTuple):
    """Tiles of ``views`` images, which are stacked vertically, numbered row by row."""

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

    # (6, S): mean x, y in pixels of the view; conic a, k, c; largest q at which alpha >= alpha_min
    shapes: Tensor
    rectangles: Tensor  # (4, S): left, top, right, bottom, exclusive, in tiles of the grid
    first_rows: Tensor  # (S,) the row of the grid where the splat's view starts


class Lists(NamedTuple):
    """Lists of splats: that of ``tiles[i]`` is ``splats[starts[i] : starts[i] + counts[i]]``, front
    to back; the longest list is first.
    """

    tiles: Tensor
    starts: Tensor
    counts: Tensor
    splats: Tensor


class Table(NamedTuple):
    """The visible splats of all views, front to back, one column each; the last has opacity 0."""

    ids: Tensor  # (S,) view * N + Gaussian
    # (8 + C, S + 1): mean x, y, conic a, k, c, opacity, then the features: colour, depth, 1
    columns: Tensor
    bounds: Bounds
    slices: list[tuple[int, int]]
    lists: list[Lists]  # of the first slices, kept by the forward pass for the backward pass
    grid: Grid
    capped: bool  # whether any opacity exceeds alpha_max


class Block(NamedTuple):
    """Part of a step: G tiles with K splats each, the last of which may have opacity 0."""

    tiles: Tensor  # (G,)
    splats: Tensor  # (G * K,)
    mean_x: Tensor  # (G, K), as are those up to opacity; means relative to the tile's centre
    mean_y: Tensor
    a: Tensor
    k: Tensor
    c: Tensor
    opacity: Tensor
    features: Tensor  # (G, C + 2, K)


class _Blend(torch.autograd.Function):
    """Sum features weighted by alpha_i T_i (B, H, W, C + 2); also return contributions (B, N)."""

    @staticmethod
    def forward(ctx, colors, absgrad, size, options, *splats):
        splats = Splats(*splats)
        table = _tabulate(splats, colors, *size, options)
        sums, largest = _forward(table, *size, options)
        ctx.save_for_backward(sums)
        ctx.table, ctx.absgrad, ctx.options = table, absgrad, options
        ctx.shape, ctx.colors_dim = splats.visible.shape, colors.dim()
        contribution = splats.depths.new_zeros(ctx.shape.numel())
        contribution = contribution.index_copy_(0, table.ids, largest[:-1]).view(ctx.shape)
        ctx.mark_non_differentiable(contribution)
        return sums, contribution

    @staticmethod
    @once_differentiable
    def backward(ctx, grad, _):
        with without_autocast(grad.device.type):
            wanted = ctx.absgrad is not None
            columns, absolute = _backward(ctx.table, *ctx.saved_tensors, grad, wanted, ctx.options)
        if wanted:
            ctx.absgrad.view(-1, 2).index_add_(0, ctx.table.ids, absolute[:, :-1].t())
        full = columns.new_zeros(ctx.shape.numel(), len(columns))
        full = full.index_copy_(0, ctx.table.ids, columns[:, :-1].t())
        channels = len(columns) - SHAPE_COLUMNS - 2
        parts = full.view(*ctx.shape, len(columns)).split([2, 3, 1, channels, 1, 1], -1)
        means2d, conics, opacities, colors, depths, _ = parts
        colors = colors if ctx.colors_dim == 3 else colors.sum(0)
        splats = (means2d, conics, opacities[..., 0], depths[..., 0], None, None)
        return colors, None, None, None, *splats


def _tabulate(splats: Splats, colors, width, height, options) -> Table:
    """Tabulate the visible splats of all views by depth, ties by index."""
    views, gaussians = splats.visible.shape
    ids = splats.visible.flatten().nonzero()[:, 0]
    ids = ids[splats.depths.flatten()[ids].argsort(stable=True)]
    means2d, conics, opacities, depths, extents = (x.flatten(0, 1)[ids] for x in splats[:5])
    colors = colors[ids % gaussians] if colors.dim() == 2 else colors.flatten(0, 1)[ids]
    grid = Grid(views, -(-height // TILE), -(-width // TILE))
    bounds = bound(means2d, conics, opacities, extents, ids // gaussians, grid, options.alpha_min)
    rows = (means2d.t(), conics.t(), opacities[None], colors.t(), depths[None])
    columns = pad(torch.cat([*rows, torch.ones_like(depths)[None]]), (0, 1))
    capped = bool((opacities > options.alpha_max).any())
    return Table(ids, columns, bounds, slices(bounds), [], grid, capped)


def _forward(
    table: Table, width: int, height: int, options: RasterizeOptions
) -> tuple[Tensor, Tensor]:
    """Return the sums (B, H, W, C + 2) and each splat's largest weight (S + 1,)."""
    transmittances = _start(table, width, height)
    sums = table.columns.new_zeros(table.grid.tiles, (len(table.columns) - SHAPE_COLUMNS) * PIXELS)
    largest = table.columns.new_zeros(table.columns.shape[1])
    for block in _march(table, transmittances, options):
        _, _, weights = composite(block, transmittances, options)
        sums.index_add_(0, block.tiles, product(block.features, weights.transpose(1, 2)).flatten(1))
        largest.scatter_reduce_(0, block.splats, weights.amax(1).flatten(), "amax")
    return from_tiles(sums, table.grid, width, height), largest


def _backward(
    table: Table, sums: Tensor, grad: Tensor, absolute: bool, options: RasterizeOptions
) -> tuple[Tensor, Tensor]:
    """Return gradients of the table's columns, and (2, S + 1) sums over pixels of the absolute
    gradient of the mean.

    With ``g_i = <grad, features_i>`` the loss is ``L = sum_i g_i alpha_i T_i``, hence
    ``alpha_i dL/dalpha_i = w_i g_i - w_i / T_{i+1} sum_{j>i} w_j g_j`` with ``w_i = alpha_i T_i``.
    Front to back, the sum over j > i is the remainder of L at the pixel, which starts as <grad,
    sums>, and T is the same cumulative product as in forward. Back to front, as usual, T would have
    to be recovered by repeated division."""
    height, width = grad.shape[1:3]
    transmittances = _start(table, width, height)
    cotangents = to_tiles(grad, table.grid)
    left = (cotangents * to_tiles(sums, table.grid)).sum(1)
    columns = torch.zeros_like(table.columns)
    absolutes = columns.new_zeros(2, columns.shape[1])
    for block in _march(table, transmittances, options):
        alphas, behind, weights = composite(block, transmittances, options)
        cotangent = cotangents.index_select(0, block.tiles)
        gains = product(cotangent.transpose(1, 2), block.features).mul_(weights)
        features = product(cotangent, weights)
        rest = subtract_one_by_one(gains, left, block.tiles)
        slopes = gains.addcmul_(weights.div_(behind), rest, value=-1)
        if table.capped:
            slopes *= alphas < options.alpha_max
        grads = torch.cat([splat_gradients(block, slopes), features], 1)
        columns.index_add_(1, block.splats, grads.transpose(0, 1).flatten(1))
        if absolute:
            found = absolute_gradients(block, slopes).transpose(0, 1).flatten(1)
            absolutes.index_add_(1, block.splats, found)
    return columns, absolutes


def _start(table: Table, width: int, height: int) -> Tensor:
    """Return the initial transmittances (tiles, PIXELS): 1 inside the image, 0 outside."""
    ones = table.columns.new_ones(table.grid.views, height, width, 1)
    return to_tiles(ones, table.grid)[:, 0]


def _march(table: Table, transmittances: Tensor, options: RasterizeOptions) -> Iterator[Block]:
    """Yield blocks front to back; the caller `composite`s each before it takes the next."""
    for lists in _lists(table, transmittances, options):
        active, depth = torch.arange(len(lists.tiles), device=lists.tiles.device), 0
        while len(active):
            size = ELEMENTS_PER_BLOCK // (SPLATS_PER_STEP * PIXELS)
            longest_of_parts = lists.counts[active[::size]].tolist()
            for part, longest in zip(active.split(size), longest_of_parts, strict=True):
                yield _block(table, lists, part, depth, min(longest - depth, SPLATS_PER_STEP))
            depth += SPLATS_PER_STEP
            unfinished = _unfinished(transmittances[lists.tiles[active]], options)
            active = active[unfinished & (lists.counts[active] > depth)]


def _lists(table: Table, transmittances: Tensor, options: RasterizeOptions) -> Iterator[Lists]:
    """Yield the lists of each slice for unfinished tiles; the first are kept for backward."""
    for i, (first, last) in enumerate(table.slices):
        if i < len(table.lists):
            yield table.lists[i]
            continue
        unfinished = _unfinished(transmittances, options)
        if len(table.lists) == i < KEPT_SLICES or unfinished.any():
            lists = list_splats(table.bounds, first, last, unfinished, table.grid)
            if len(table.lists) == i < KEPT_SLICES:
                table.lists.append(lists)
            yield lists


def _unfinished(transmittances: Tensor, options: RasterizeOptions) -> Tensor:
    return transmittances.amax(1) >= options.stop


def _block(table: Table, lists: Lists, part: Tensor, depth: int, length: int) -> Block:
    """Return the intersections ``depth`` to ``depth + length - 1`` of the lists ``part``."""
    places = depth + torch.arange(length, device=part.device)
    positions = (lists.starts[part, None] + places).clamp(max=len(lists.splats) - 1)
    nothing = table.columns.shape[1] - 1
    splats = lists.splats[positions].long()
    splats = torch.where(places < lists.counts[part, None], splats, nothing).flatten()
    columns = table.columns.index_select(1, splats).view(-1, len(part), length)
    tiles = lists.tiles[part]
    middle_x, middle_y = (origin[:, None] + TILE / 2 for origin in table.grid.origins(tiles))
    mean_x, mean_y, *conic_and_opacity = columns[:SHAPE_COLUMNS]
    features = columns[SHAPE_COLUMNS:].transpose(0, 1).contiguous()
    return Block(tiles, splats, mean_x - middle_x, mean_y - middle_y, *conic_and_opacity, features)


# ---- lists of the splats of each tile, in bounded memory -----------------------------------------


def bound(means2d, conics, opacities, extents, views, grid: Grid, alpha_min: float) -> Bounds:
    """Compute the rectangle of tiles around alpha >= alpha_min for each splat of ``views`` (S,)."""
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
    """Split the splats into ranges (first, last + 1) of a bounded number of candidate tiles."""
    size = bounds.rectangles[2:] - bounds.rectangles[:2]
    part = size.clamp(min=0).prod(0).cumsum(0) // CANDIDATES_PER_SLICE
    ends = part.unique_consecutive(return_counts=True)[1].cumsum(0).tolist()
    return list(pairwise([0, *ends]))


def list_splats(bounds: Bounds, first: int, last: int, unfinished: Tensor, grid: Grid) -> Lists:
    """List the splats ``first`` to ``last - 1`` by ``unfinished`` tile (tiles,) that they reach."""
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
    tiles, counts = tiles.unique_consecutive(return_counts=True)
    starts, longest = counts.cumsum(0) - counts, counts.argsort(descending=True, stable=True)
    return Lists(tiles[longest].long(), starts[longest], counts[longest], splats[order] + first)


def _test(
    shapes: Tensor, boxes: Tensor, splats: Tensor, first: int, unfinished: Tensor, grid: Grid
) -> tuple[Tensor, Tensor]:
    """Return tiles and splats of those candidates, numbered from ``first``, that `_reaches`."""
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


# ---- within a block ------------------------------------------------------------------------------


def _alphas(block: Block, options: RasterizeOptions) -> Tensor:
    """Compute ``min(alpha_max, opacity exp(-q / 2))``, or zero below alpha_min: (G, PIXELS, K).

    With ``q / 2 = (x(column) - y(row))^2 + z(row)``, only the square has the size of the block.
    """
    steep = (block.a / 2).sqrt()[:, None]
    from_x, from_y = _offsets(block.mean_x), _offsets(block.mean_y)
    x, y = steep * from_x, steep * block.k[:, None] * from_y
    top = block.opacity.clamp(min=FAINTEST).log()[:, None] - block.c[:, None] / 2 * from_y**2
    root = x[:, None] - y[:, :, None]
    alphas = torch.addcmul(top[:, :, None], root, root, value=-1).exp_()
    alphas.clamp_(max=options.alpha_max)
    return threshold_(alphas, _just_below(options.alpha_min, alphas), 0.0).flatten(1, 2)


def composite(
    block: Block, transmittances: Tensor, options: RasterizeOptions
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute alphas, ``T_{i+1}`` and weights ``alpha_i T_i``, each (G, PIXELS, K); update the
    tiles' transmittances to those behind the block.

    Weights are zero where ``T_i < stop``, but the transmittances continue to decrease there. A
    ``T_{i+1}`` that is too small to divide by is returned as infinity, which makes the quotient
    zero."""
    alphas = _alphas(block, options)
    chain = alphas.new_empty(*alphas.shape[:2], alphas.shape[2] + 1)
    chain[..., 0] = transmittances.index_select(0, block.tiles)
    torch.sub(alphas.new_ones(()), alphas, out=chain[..., 1:])
    torch.cumprod(chain, -1, out=chain)
    transmittances.index_copy_(0, block.tiles, chain[..., -1])
    weights = threshold(chain[..., :-1], _just_below(options.stop, chain), 0.0).mul_(alphas)
    return alphas, threshold_(chain[..., 1:], FAINTEST, torch.inf), weights


def subtract_one_by_one(gains: Tensor, left: Tensor, tiles: Tensor) -> Tensor:
    """Return what is left behind each splat, (G, PIXELS, K), and update ``left``."""
    rest = torch.cat([left.index_select(0, tiles)[..., None], gains.neg()], -1)
    torch.cumsum(rest, -1, out=rest)
    left.index_copy_(0, tiles, rest[..., -1])
    return rest[..., 1:]


def splat_gradients(block: Block, slopes: Tensor) -> Tensor:
    """Compute the gradients (G, 6, K) of mean x, y, a, k, c and opacity from ``slopes``, the
    gradients of the exponent ``log(opacity) - q / 2``.

    They are linear in the six moments of the slopes over the tile's pixels, those of (1, x, y, x^2,
    x y, y^2) relative to its centre."""
    s, sx, sy, sxx, sxy, syy = product(_monomials(slopes), slopes).unbind(1)
    k, y = block.k, -block.mean_y
    t = -block.mean_x - k * y  # d.x - k d.y at the tile's centre; elsewhere x - k y is added
    st, sty, sd = sx - k * sy, sxy - k * syy, sy + y * s
    slopes_t = st + t * s
    slopes_tt = sxx - k * sxy - k * sty + t * (2 * st + t * s)
    slopes_td = sty + t * sy + y * slopes_t
    slopes_dd = syy + y * (sy + sd)
    grad_x = block.a * slopes_t
    grad_y = block.c * sd - k * grad_x
    conics = (-slopes_tt / 2, block.a * slopes_td, -slopes_dd / 2)
    return torch.stack([grad_x, grad_y, *conics, s / block.opacity.clamp(min=FAINTEST)], 1)


def absolute_gradients(block: Block, slopes: Tensor) -> Tensor:
    """Sum |gradient of mean x| and |gradient of mean y| over the pixels: (G, 2, K)."""
    from_x, from_y = _offsets(block.mean_x)[:, None], _offsets(block.mean_y)[:, :, None]
    slopes = slopes.view(len(slopes), TILE, TILE, -1)
    k, c = block.k[:, None, None], block.c[:, None, None]
    along_x = block.a[:, None, None] * (from_x - k * from_y)
    along = along_x, c * from_y - k * along_x
    return torch.stack([(slopes * gradient).abs().sum((1, 2)) for gradient in along], 1)


def product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply batches of matrices; one of one is duplicated, since threads may share its sums."""
    return a @ b if len(b) > 1 else (a @ b.repeat(2, 1, 1))[:1]


def _offsets(means: Tensor) -> Tensor:
    """Subtract the means (G, K) from the pixel centres of a row or column: (G, TILE, K)."""
    return _centres(means)[:, None] - means[:, None]


def _centres(like: Tensor) -> Tensor:
    return torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2


def _monomials(like: Tensor) -> Tensor:
    """Return 1, x, y, x^2, x y, y^2 at the pixel centres relative to the tile's: (6, PIXELS)."""
    grid = torch.meshgrid(_centres(like), _centres(like), indexing="ij")
    y, x = (axis.flatten() for axis in grid)
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _just_below(bound: float, like: Tensor) -> float:
    """Return the largest number below ``bound``, since ``threshold`` drops values equal to it."""
    bound = torch.tensor(bound, dtype=like.dtype)
    return torch.nextafter(bound, torch.tensor(-torch.inf, dtype=like.dtype)).item()


def to_tiles(image: Tensor, grid: Grid) -> Tensor:
    """Convert (B, H, W, F) to (tiles, F, PIXELS), with zeros outside the image."""
    views, height, width, features = image.shape
    image = pad(image, (0, 0, 0, grid.columns * TILE - width, 0, grid.rows * TILE - height))
    image = image.view(views, grid.rows, TILE, grid.columns, TILE, features)
    return image.permute(0, 1, 3, 5, 2, 4).reshape(grid.tiles, features, PIXELS)


def from_tiles(tiles: Tensor, grid: Grid, width: int, height: int) -> Tensor:
    """Invert `to_tiles`."""
    tiles = tiles.view(grid.views, grid.rows, grid.columns, -1, TILE, TILE)
    image = tiles.permute(0, 1, 4, 2, 5, 3)
    image = image.reshape(grid.views, grid.rows * TILE, grid.columns * TILE, -1)
    return image[:, :height, :width].contiguous()
