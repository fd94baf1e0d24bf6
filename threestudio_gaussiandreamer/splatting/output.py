"""The output of every backend, and the last stage of the torch ones: background, downsampling."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from .options import RasterizeOptions
from .projection import Splats


class Rasterized(NamedTuple):
    """B views of N Gaussians with C colour channels, H x W pixels after downsampling."""

    image: Float[Tensor, "B H W C"]
    alpha: Float[Tensor, "B H W 1"]  # in [0, 1]
    depth: Float[Tensor, "B H W 1"]  # sum of t.z alpha_i T_i, world units, not normalised
    means2d: Float[
        Tensor, "B N 2"
    ]  # pixels before downsampling; backward fills ``.grad`` and, if asked, ``.absgrad``
    radii: Float[
        Tensor, "B N"
    ]  # pixels before downsampling, the larger half extent of alpha >= alpha_min; 0 when culled
    contribution: Float[
        Tensor, "B N"
    ]  # the largest alpha_i T_i over the pixels of the view; no gradient


def track_means2d(splats: Splats, others: tuple[Tensor, ...], absgrad: bool) -> Tensor:
    """Return ``splats.means2d`` set up to retain its gradient if any input requires one."""
    means2d = splats.means2d
    if torch.is_grad_enabled() and any(x.requires_grad for x in (*splats, *others)):
        means2d = means2d if means2d.requires_grad else means2d.requires_grad_()
        means2d.retain_grad()
        if absgrad:
            means2d.absgrad = torch.zeros_like(means2d, requires_grad=False)
    return means2d


def compose(
    sums: Float[Tensor, "B H W C+2"],
    splats: Splats,
    contribution: Tensor,
    background: Tensor,
    options: RasterizeOptions,
) -> Rasterized:
    """Composite the sums of (colour, depth, 1), weighted by ``alpha_i T_i``, over the background,
    after downsampling them with a box filter.

    ``alpha = sum_i alpha_i T_i = 1 - T_end``, so ``image = colour + (1 - alpha) background``.
    """
    if options.downsample > 1:
        sums = _box(sums, options.downsample)
    image, depth, alpha = sums[..., :-2], sums[..., -2:-1], sums[..., -1:]
    image = image + (1 - alpha) * background[:, None, None]
    return Rasterized(image, alpha, depth, splats.means2d, splats.radii, contribution)


def _box(x: Tensor, size: int) -> Tensor:
    """Average (B, H, W, C) over boxes of ``size`` x ``size`` pixels."""
    batch, height, width, channels = x.shape
    return x.reshape(batch, height // size, size, width // size, size, channels).mean((2, 4))
