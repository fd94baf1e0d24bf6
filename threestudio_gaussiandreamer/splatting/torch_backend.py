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
from typing import NamedTuple, Optional

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable
from torch.nn.functional import pad
from torch.utils.checkpoint import checkpoint

from ..core.devices import without_autocast
from .options import RasterizeOptions
from .output import Rasterized, compose, track_means2d
from .projection import Splats, project
from .scene import Scene
from .tiles import TILE, Bounds, Grid, Lists, bound, list_splats, make_grid, slices
from .torch_blocks import (
    PIXELS,
    Block,
    absolute_gradients,
    composite,
    from_tiles,
    product,
    splat_gradients,
    subtract_one_by_one,
    to_tiles,
)

SPLATS_PER_STEP = 64
ELEMENTS_PER_BLOCK = 2**20
KEPT_SLICES = 4
PROJECTED_AT_ONCE = 2**18
SHAPE_COLUMNS = 6
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")


def unavailable() -> Optional[str]:
    """Return None: plain torch runs everywhere."""


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    splats = _project(scene, options)
    tracked = (scene.colors, scene.background)
    splats = splats._replace(means2d=track_means2d(splats, tracked, options.absgrad))
    absgrad = getattr(splats.means2d, "absgrad", None)
    sums, contribution = _Blend.apply(*splats, scene.colors, absgrad, *scene.size, options)
    return compose(sums, splats, contribution, scene.background, options)


def _project(scene: Scene, options: RasterizeOptions) -> Splats:
    """Call `project`, for many Gaussians in parts that are recomputed in backward, since autograd
    stores about a hundred numbers per Gaussian and view.
    """
    size = max(1, PROJECTED_AT_ONCE // len(scene.viewmats))
    if len(scene.means) <= size:
        return project(scene, options)
    gaussians = {name: getattr(scene, name) for name in GAUSSIANS}
    split = (x.split(size, -1 if x.dim() == 1 else -2) for x in gaussians.values())
    parts = [
        scene._replace(**dict(zip(gaussians, part, strict=True)))
        for part in zip(*split, strict=True)
    ]
    again = {"use_reentrant": False, "preserve_rng_state": False}
    projected = [checkpoint(project, part, options, **again) for part in parts]
    return Splats(*(torch.cat(x, 1) for x in zip(*projected, strict=True)))


class Table(NamedTuple):
    """The visible splats of all views, front to back, one column each; the last column is padding,
    a splat with opacity 0.
    """

    ids: Tensor  # (S,) view * N + Gaussian
    # (8 + C, S + 1): mean x, y, conic a, k, c, opacity, then the features: colour, depth, 1
    columns: Tensor
    bounds: Bounds
    slices: list[tuple[int, int]]
    lists: list[Lists]  # of the first slices, kept by the forward pass for the backward pass
    grid: Grid
    capped: bool  # whether any opacity exceeds alpha_max


class _Blend(torch.autograd.Function):
    """Sum features weighted by alpha_i T_i (B, H, W, C + 2); also return contributions (B, N)."""

    @staticmethod
    def forward(
        ctx,
        means2d,
        conics,
        opacities,
        depths,
        extents,
        visible,
        colors,
        absgrad,
        width,
        height,
        options,
    ):
        table = _tabulate(
            means2d, conics, opacities, depths, extents, visible, colors, width, height, options
        )
        sums, largest = _forward(table, width, height, options)
        ctx.save_for_backward(sums)
        ctx.table, ctx.absgrad, ctx.options, ctx.shape, ctx.colors_dim = (
            table,
            absgrad,
            options,
            visible.shape,
            colors.dim(),
        )
        contribution = (
            depths.new_zeros(visible.numel())
            .index_copy_(0, table.ids, largest[:-1])
            .view(visible.shape)
        )
        ctx.mark_non_differentiable(contribution)
        return sums, contribution

    @staticmethod
    @once_differentiable
    def backward(ctx, grad, _):
        with without_autocast(grad.device.type):
            columns, absolute = _backward(
                ctx.table, *ctx.saved_tensors, grad, ctx.absgrad is not None, ctx.options
            )
        if ctx.absgrad is not None:
            ctx.absgrad.view(-1, 2).index_add_(0, ctx.table.ids, absolute[:, :-1].t())
        full = columns.new_zeros(ctx.shape.numel(), len(columns)).index_copy_(
            0, ctx.table.ids, columns[:, :-1].t()
        )
        channels = len(columns) - SHAPE_COLUMNS - 2
        parts = full.view(*ctx.shape, len(columns)).split([2, 3, 1, channels, 1, 1], -1)
        means2d, conics, opacities, colors, depths, _ = parts
        colors = colors if ctx.colors_dim == 3 else colors.sum(0)
        return (
            means2d,
            conics,
            opacities[..., 0],
            depths[..., 0],
            None,
            None,
            colors,
            None,
            None,
            None,
            None,
        )


def _tabulate(
    means2d, conics, opacities, depths, extents, visible, colors, width, height, options
) -> Table:
    """Tabulate the visible splats of all views by depth, ties by index."""
    views, gaussians = visible.shape
    ids = visible.flatten().nonzero()[:, 0]
    ids = ids[depths.flatten()[ids].argsort(stable=True)]
    means2d, conics, opacities, depths, extents = (
        x.flatten(0, 1)[ids] for x in (means2d, conics, opacities, depths, extents)
    )
    colors = colors[ids % gaussians] if colors.dim() == 2 else colors.flatten(0, 1)[ids]
    grid = make_grid(views, width, height)
    bounds = bound(means2d, conics, opacities, extents, ids // gaussians, grid, options.alpha_min)
    columns = torch.cat(
        [
            means2d.t(),
            conics.t(),
            opacities[None],
            colors.t(),
            depths[None],
            torch.ones_like(depths)[None],
        ]
    )
    columns = pad(columns, (0, 1))
    return Table(
        ids, columns, bounds, slices(bounds), [], grid, bool((opacities > options.alpha_max).any())
    )


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
            absolutes.index_add_(
                1, block.splats, absolute_gradients(block, slopes).transpose(0, 1).flatten(1)
            )
    return columns, absolutes


def _start(table: Table, width: int, height: int) -> Tensor:
    """Return the initial transmittances (tiles, PIXELS): 1 inside the image, 0 outside."""
    ones = table.columns.new_ones(table.grid.views, height, width, 1)
    return to_tiles(ones, table.grid)[:, 0]


def _march(table: Table, transmittances: Tensor, options: RasterizeOptions) -> Iterator[Block]:
    """Yield blocks front to back; the caller updates the transmittances with each (`composite`)
    before it takes the next.
    """
    for lists in _lists(table, transmittances, options):
        active, depth = torch.arange(len(lists.tiles), device=lists.tiles.device), 0
        while len(active):
            size = ELEMENTS_PER_BLOCK // (SPLATS_PER_STEP * PIXELS)
            for part, longest in zip(
                active.split(size), lists.counts[active[::size]].tolist(), strict=True
            ):
                yield _block(table, lists, part, depth, min(longest - depth, SPLATS_PER_STEP))
            depth += SPLATS_PER_STEP
            active = active[
                _unfinished(transmittances[lists.tiles[active]], options)
                & (lists.counts[active] > depth)
            ]


def _lists(table: Table, transmittances: Tensor, options: RasterizeOptions) -> Iterator[Lists]:
    """Yield the tile lists of each slice in turn, for the tiles that are unfinished by then; those
    of the first slices are kept for backward.
    """
    for i, (first, last) in enumerate(table.slices):
        if i == len(table.lists) < KEPT_SLICES:
            table.lists.append(
                list_splats(
                    table.bounds, first, last, _unfinished(transmittances, options), table.grid
                )
            )
        if i < len(table.lists):
            yield table.lists[i]
        elif (unfinished := _unfinished(transmittances, options)).any():
            yield list_splats(table.bounds, first, last, unfinished, table.grid)


def _unfinished(transmittances: Tensor, options: RasterizeOptions) -> Tensor:
    return transmittances.amax(1) >= options.stop


def _block(table: Table, lists: Lists, part: Tensor, depth: int, length: int) -> Block:
    """Return the intersections ``depth`` to ``depth + length - 1`` of the lists named by
    ``part``.
    """
    places = depth + torch.arange(length, device=part.device)
    positions = (lists.starts[part, None] + places).clamp(max=len(lists.splats) - 1)
    nothing = table.columns.shape[1] - 1
    splats = torch.where(
        places < lists.counts[part, None], lists.splats[positions].long(), nothing
    ).flatten()
    columns = table.columns.index_select(1, splats).view(-1, len(part), length)
    tiles = lists.tiles[part]
    middle_x, middle_y = (origin[:, None] + TILE / 2 for origin in table.grid.origins(tiles))
    mean_x, mean_y, *conic_and_opacity = columns[:SHAPE_COLUMNS]
    features = columns[SHAPE_COLUMNS:].transpose(0, 1).contiguous()
    return Block(tiles, splats, mean_x - middle_x, mean_y - middle_y, *conic_and_opacity, features)
