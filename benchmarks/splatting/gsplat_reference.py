"""gsplat's plain-torch functions (`gsplat.cuda._torch_impl`) as a contender: pip install gsplat.

They need CUDA for three helpers: the pixels that a Gaussian covers, and two functions of nerfacc.
This module replaces these three by vectorised torch; projection, compositing and everything with a
gradient is gsplat's.
"""

import sys
import types
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

ALPHA_MIN, STOP, SIGMAS = 1 / 255, 1e-4, 3.33
"""gsplat's."""


def drawer(viewmat: Tensor, K: Tensor, size: int) -> Callable[[Any], tuple[Tensor, ...]]:
    """Return a function that renders a scene (means, quats, scales, opacities, colors) from one
    camera: image, depth, alpha.
    """
    sys.modules.setdefault("nerfacc", nerfacc())
    from gsplat.cuda import _torch_impl as gsplat

    def draw(scene: Any) -> tuple[Tensor, ...]:
        covariances, _ = gsplat._quat_scale_to_covar_preci(scene.quats, scene.scales, True, False)
        projected = gsplat._fully_fused_projection(
            scene.means, covariances, viewmat[None], K[None], size, size
        )
        _, means2d, depths, conics, _ = projected
        opacities, features = (
            scene.opacities[None],
            torch.cat([scene.colors[None], depths[..., None]], -1),
        )
        with torch.no_grad():
            gaussians, pixels = pairs(means2d[0], conics[0], scene.opacities, depths[0], size)
        images = torch.zeros_like(gaussians)
        image, alpha = gsplat.accumulate(
            means2d, conics, opacities, features, gaussians, pixels, images, size, size
        )
        return image[..., :3], image[..., 3:], alpha

    return draw


def pairs(
    means2d: Tensor, conics: Tensor, opacities: Tensor, depths: Tensor, size: int
) -> tuple[Tensor, Tensor]:
    """Return (Gaussian, pixel) of every alpha >= 1/255 before early termination, by pixel and
    depth.

    The candidates are the pixels of each Gaussian's box of 3.33 standard deviations.
    """
    determinant = conics[:, 0] * conics[:, 2] - conics[:, 1] ** 2
    reach = SIGMAS * torch.stack([conics[:, 2], conics[:, 0]], -1).div(determinant[:, None]).sqrt()
    low = (means2d - reach).floor().clamp(0, size).long()
    wide = ((means2d + reach).ceil().clamp(0, size).long() - low).clamp_min(0)
    front_to_back = depths.argsort()
    gaussian, place = expanded(wide.prod(-1)[front_to_back])
    gaussian = front_to_back[gaussian]
    x, y = (
        low[gaussian, 0] + place % wide[gaussian, 0],
        low[gaussian, 1] + place // wide[gaussian, 0],
    )
    dx, dy = x + 0.5 - means2d[gaussian, 0], y + 0.5 - means2d[gaussian, 1]
    a, b, c = conics[gaussian].unbind(-1)
    alphas = (
        opacities[gaussian] * torch.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    ).clamp_max(0.999)
    seen = alphas >= ALPHA_MIN
    gaussian, pixel, alphas = gaussian[seen], (y * size + x)[seen], alphas[seen]
    order = pixel.argsort(stable=True)  # stable: front to back within a pixel
    gaussian, pixel, alphas = gaussian[order], pixel[order], alphas[order]
    visible = transmittance(alphas, pixel) * (1 - alphas) > STOP
    return gaussian[visible], pixel[visible]


def expanded(counts: Tensor) -> tuple[Tensor, Tensor]:
    """For counts [2, 0, 3] return the rows [0, 0, 2, 2, 2] and the positions [0, 1, 0, 1, 2]."""
    rows = torch.repeat_interleave(counts)
    return rows, torch.arange(len(rows)) - (counts.cumsum(0) - counts)[rows]


def transmittance(alphas: Tensor, rays: Tensor) -> Tensor:
    """Return the product of 1 - alpha over everything in front on the same ray; rays in order, in
    float64 for the long sums.
    """
    logs = torch.log1p(-alphas.double())
    before = logs.cumsum(0) - logs
    first = torch.cat([rays.new_ones(1, dtype=torch.bool), rays[1:] != rays[:-1]])
    start = before[first][first.long().cumsum(0) - 1]
    return (before - start).exp().to(alphas.dtype)


def nerfacc() -> types.ModuleType:
    """Provide the two functions of nerfacc that gsplat's compositing calls."""

    def render_weight_from_alpha(
        alphas: Tensor, ray_indices: Tensor, n_rays: int
    ) -> tuple[Tensor, Tensor]:
        T = transmittance(alphas, ray_indices)
        return alphas * T, T

    def accumulate_along_rays(
        weights: Tensor, values: Tensor | None, ray_indices: Tensor, n_rays: int
    ) -> Tensor:
        values = weights[:, None] if values is None else weights[:, None] * values
        return values.new_zeros(n_rays, values.shape[1]).index_add(0, ray_indices, values)

    module = types.ModuleType("nerfacc")
    module.render_weight_from_alpha, module.accumulate_along_rays = (
        render_weight_from_alpha,
        accumulate_along_rays,
    )
    return module
