"""The image model's specification: every pixel evaluates every visible Gaussian, under autograd.

Four stages: `project` (projection.py), `sort`, `blend`, `compose`. Written for readability and as
the reference in tests, in float32 and float64. There are no tiles; pixels are processed in chunks
to bound the memory. ``alpha_min=0, alpha_max=1, stop=0`` disable the cut-offs."""

from typing import NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from .projection import Splats, project
from .scene import Rasterized, RasterizeOptions, Scene

CHUNK_BYTES = 2**29
TENSORS_PER_PAIR = 24


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    splats = project(scene, options)
    tracked = (scene.colors, scene.background)
    splats = splats._replace(means2d=track_means2d(splats, tracked, options.absgrad))
    colors = scene.colors.expand(len(scene.viewmats), -1, -1)
    numbers = range(len(scene.viewmats))
    views = [render_view(splats, colors, view, *scene.size, options) for view in numbers]
    sums, contribution = (torch.stack(x) for x in zip(*views, strict=True))
    sums = sums.unflatten(1, (scene.height, scene.width))
    return compose(sums, splats, contribution, scene.background, options)


class Sorted(NamedTuple):
    """The M visible Gaussians of one view, front to back."""

    ids: Tensor  # (M,)
    means2d: Tensor  # (M, 2)
    conics: Tensor  # (M, 3)
    opacities: Tensor  # (M,)
    features: Tensor  # (M, C + 2): colour, depth, 1


def render_view(
    splats: Splats, colors: Tensor, view: int, width: int, height: int, options: RasterizeOptions
) -> tuple[Tensor, Tensor]:
    """Return the sums of `blend` (H*W, C + 2) for one view, and the contributions (N,)."""
    front_to_back = sort(splats, colors, view)
    absgrad = splats.means2d.absgrad[view] if hasattr(splats.means2d, "absgrad") else None
    pairs = splats.opacities.element_size() * max(1, len(front_to_back.ids))
    at_once = max(1, CHUNK_BYTES // (TENSORS_PER_PAIR * pairs))
    chunks = pixel_centres(width, height, splats.depths).split(at_once)
    blended = [
        _blend_in_bounded_memory(len(chunks) > 1, pixels, front_to_back, options, absgrad)
        for pixels in chunks
    ]
    sums, largest = zip(*blended, strict=True)
    contribution = splats.depths.new_zeros(splats.depths.shape[1])
    largest = torch.stack(largest).amax(0)
    return torch.cat(sums), contribution.index_copy(0, front_to_back.ids, largest)


def sort(splats: Splats, colors: Tensor, view: int) -> Sorted:
    """Sort the visible Gaussians by the depth of their mean, ties by index."""
    visible = splats.visible[view].nonzero()[:, 0]
    ids = visible[splats.depths[view, visible].argsort(stable=True)]
    means2d, conics, opacities, depths = (x[view, ids] for x in splats[:4])
    depth_and_one = torch.stack([depths, torch.ones_like(depths)], 1)
    features = torch.cat([colors[view, ids], depth_and_one], 1)
    return Sorted(ids, means2d, conics, opacities, features)


def blend(
    pixels: Tensor, splats: Sorted, options: RasterizeOptions, absgrad: Optional[Tensor]
) -> tuple[Tensor, Tensor]:
    """Composite M Gaussians at P pixels, front to back (Porter and Duff 1984; Kerbl et al. 2023).

    ``alpha_i = min(alpha_max, opacity_i exp(-q_i / 2))``, zero below ``alpha_min``; ``T_i =
    prod_{j<i} (1 - alpha_j)``. Gaussians with ``T_i >= stop`` are blended, so the one that brings T
    below ``stop`` is the last. Returns ``sum_i features_i alpha_i T_i`` (P, C + 2) and ``max_pixels
    alpha_i T_i`` (M,)."""
    offsets = pixels[:, None] - splats.means2d
    if absgrad is not None and offsets.requires_grad:
        offsets.register_hook(lambda grad: _accumulate(absgrad, splats.ids, grad.abs().sum(0)))
    a, k, c = splats.conics.unbind(-1)
    q = a * (offsets[..., 0] - k * offsets[..., 1]) ** 2 + c * offsets[..., 1] ** 2
    alphas = (splats.opacities * torch.exp(-0.5 * q)).clamp(max=options.alpha_max)
    alphas = torch.where(alphas >= options.alpha_min, alphas, 0)
    transmittances = torch.cat([torch.ones_like(alphas[:, :1]), (1 - alphas[:, :-1]).cumprod(1)], 1)
    weights = torch.where(transmittances >= options.stop, alphas * transmittances, 0)
    # Not a matrix product, which autocast would round to bfloat16 if it were on during backward.
    return (weights[..., None] * splats.features).sum(1), weights.detach().amax(0)


def _accumulate(total: Tensor, ids: Tensor, values: Tensor) -> None:
    """Add in place and return None, since a tensor returned by a hook replaces the gradient."""
    total.index_add_(0, ids, values)


def pixel_centres(width: int, height: int, like: Tensor) -> Tensor:
    """Return x, y of the pixel centres (H*W, 2), row by row from the top."""
    rows, columns = (torch.arange(size).to(like) + 0.5 for size in (height, width))
    y, x = torch.meshgrid(rows, columns, indexing="ij")
    return torch.stack([x, y], -1).reshape(-1, 2)


def _blend_in_bounded_memory(bounded: bool, *arguments) -> tuple[Tensor, Tensor]:
    """Call `blend`; if ``bounded``, recompute it in backward instead of storing intermediates."""
    if not bounded:
        return blend(*arguments)
    # A closure, because absgrad is modified in backward, which checkpoint forbids for arguments.
    return checkpoint(lambda: blend(*arguments), use_reentrant=False, preserve_rng_state=False)


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
        (batch, height, width, channels), size = sums.shape, options.downsample
        boxes = sums.reshape(batch, height // size, size, width // size, size, channels)
        sums = boxes.mean((2, 4))
    image, depth, alpha = sums[..., :-2], sums[..., -2:-1], sums[..., -1:]
    image = image + (1 - alpha) * background[:, None, None]
    return Rasterized(image, alpha, depth, splats.means2d, splats.radii, contribution)
