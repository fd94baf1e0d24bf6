"""Alphas, weights and their gradients within a block of the torch backend, G tiles with K splats
each; conversion of images to and from tiles.

No intermediate is larger than a block. On a CPU the results are bitwise identical for any number of
threads."""

from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn.functional import pad, threshold, threshold_

from .options import RasterizeOptions
from .tiles import TILE, Grid

PIXELS = TILE * TILE
FAINTEST = 1e-30


class Block(NamedTuple):
    """Part of a step: G tiles with K splats each; shorter lists are padded with a splat of opacity
    0.
    """

    tiles: Tensor  # (G,)
    splats: Tensor  # (G * K,)
    mean_x: Tensor  # (G, K), as are those up to opacity; means relative to the tile's centre
    mean_y: Tensor
    a: Tensor
    k: Tensor
    c: Tensor
    opacity: Tensor
    features: Tensor  # (G, C + 2, K)


def _alphas(block: Block, options: RasterizeOptions) -> Tensor:
    """Compute ``min(alpha_max, opacity exp(-q / 2))``, or zero below alpha_min: (G, PIXELS, K).

    With ``q / 2 = (x(column) - y(row))^2 + z(row)``, only the square has the size of the block.
    """
    steep = (block.a / 2).sqrt()[:, None]
    from_x, from_y = _offsets(block.mean_x), _offsets(block.mean_y)
    x, y = steep * from_x, steep * block.k[:, None] * from_y
    top = block.opacity.clamp(min=FAINTEST).log()[:, None] - block.c[:, None] / 2 * from_y**2
    root = x[:, None] - y[:, :, None]
    alphas = (
        torch.addcmul(top[:, :, None], root, root, value=-1).exp_().clamp_(max=options.alpha_max)
    )
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
    """Subtract the gains from ``left`` one after another, front to back; return the remainder
    behind each splat, (G, PIXELS, K), and update ``left``.
    """
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
    return torch.stack(
        [
            grad_x,
            grad_y,
            -slopes_tt / 2,
            block.a * slopes_td,
            -slopes_dd / 2,
            s / block.opacity.clamp(min=FAINTEST),
        ],
        1,
    )


def absolute_gradients(block: Block, slopes: Tensor) -> Tensor:
    """Sum |gradient of mean x| and |gradient of mean y| over the pixels: (G, 2, K)."""
    from_x, from_y = _offsets(block.mean_x)[:, None], _offsets(block.mean_y)[:, :, None]
    slopes = slopes.view(len(slopes), TILE, TILE, -1)
    k, c = block.k[:, None, None], block.c[:, None, None]
    along_x = block.a[:, None, None] * (from_x - k * from_y)
    return torch.stack(
        [
            (slopes * along_x).abs().sum((1, 2)),
            (slopes * (c * from_y - k * along_x)).abs().sum((1, 2)),
        ],
        1,
    )


def product(a: Tensor, b: Tensor) -> Tensor:
    """Multiply batches of matrices. A batch of one is duplicated: the product of a single pair may
    be split among threads, so that its rounding would depend on their number.
    """
    return a @ b if len(b) > 1 else (a @ b.repeat(2, 1, 1))[:1]


def _offsets(means: Tensor) -> Tensor:
    """Subtract the means (G, K) from the pixel centres of a row or column, both relative to the
    tile's centre: (G, TILE, K).
    """
    return _centres(means)[:, None] - means[:, None]


def _centres(like: Tensor) -> Tensor:
    return torch.arange(TILE, dtype=like.dtype, device=like.device) - (TILE - 1) / 2


def _monomials(like: Tensor) -> Tensor:
    """Return 1, x, y, x^2, x y, y^2 at the pixel centres relative to the tile's: (6, PIXELS)."""
    y, x = (
        axis.flatten() for axis in torch.meshgrid(_centres(like), _centres(like), indexing="ij")
    )
    return torch.stack([torch.ones_like(x), x, y, x * x, x * y, y * y])


def _just_below(bound: float, like: Tensor) -> float:
    """Return the largest number below ``bound`` in the type of ``like``, since torch's
    ``threshold`` keeps only values strictly above its bound.
    """
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
    tiles = tiles.view(grid.views, grid.rows, grid.columns, -1, TILE, TILE).permute(
        0, 1, 4, 2, 5, 3
    )
    return tiles.reshape(grid.views, grid.rows * TILE, grid.columns * TILE, -1)[
        :, :height, :width
    ].contiguous()
