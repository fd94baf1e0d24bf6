"""Gaussian noise that is attached to surfaces, so that all views of a point see the same noise.

Space is divided into cubic cells, each with its own standard normal values, one per channel. A
pixel of the latent covers ``SAMPLES`` x ``SAMPLES`` points of the rendered surface; its noise is
the sum of their cells' values over the square root of the sum's variance, so each pixel is standard
normal, and pixels are independent unless they see the same cell. A cell's size is a power of two,
from half the distance of two such points at the origin to all of it (surfaces are nearer to the
camera than the origin, so their points are closer): views from similar distances share their cells.

The values stand in a table that a hash of the cell looks up."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ..cameras import focal_length

SAMPLES = 2
TABLE = 2**16
"""Rows of the table of values, a power of two."""
PRIMES = (73856093, 19349663, 83492791)
"""Factors of the hash of Teschner et al. (2003)."""
OPAQUE = 0.5
"""Alpha below which a point belongs to the background, which has the noise of the image."""


def surface_points(
    depth: Float[Tensor, "B h w"], c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"]
) -> list[Float[Tensor, "B h w"]]:
    """Return the three world coordinates of the points on the rendered surface.

    Args:
        depth: along the optical axis, at the centres of h x w pixels.
        c2w: OpenGL cameras, see ``cameras.py``; fovy in radians.
    """
    height, width = depth.shape[1:]
    focal = focal_length(fovy, height)[:, None]
    right = (torch.arange(width, device=depth.device) + 0.5 - width / 2) / focal
    up = (height / 2 - 0.5 - torch.arange(height, device=depth.device)) / focal
    axes = c2w[:, :3, :, None]
    return [
        axis[:, 3, None]
        + depth * ((axis[:, 0] * right - axis[:, 2])[:, None] + (axis[:, 1] * up)[..., None])
        for axis in axes.unbind(1)
    ]


def cells(points: list[Float[Tensor, "B h w"]], size: Float[Tensor, " B"]) -> Int[Tensor, "B h w"]:
    """Return the hash of each point's cell, in [0, TABLE).

    Args:
        points: the three coordinates.
        size: of the cells, world units.
    """
    scale = (1 / size)[:, None, None]
    x, y, z = (
        torch.floor(axis * scale).int() * prime for axis, prime in zip(points, PRIMES, strict=True)
    )
    return (x ^ y ^ z) & (TABLE - 1)


def cell_size(
    c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], height: int
) -> Float[Tensor, " B"]:
    """Return the size of each view's cells, world units.

    Args:
        height: of the latent, pixels.
    """
    footprint = c2w[:, :3, 3].norm(dim=1) / focal_length(fovy, height)
    return torch.exp2(torch.floor(torch.log2(footprint.clamp_min(1e-6) / SAMPLES)))


def attach_noise(
    image_noise: Float[Tensor, "B c h w"],
    table: Float[Tensor, "TABLE c"],
    depth: Float[Tensor, "B H W 1"],
    opacity: Float[Tensor, "B H W 1"],
    c2w: Float[Tensor, "B 4 4"],
    fovy: Float[Tensor, " B"],
) -> Float[Tensor, "B c h w"]:
    """Return the noise of the latents' pixels: that of the surface where there is one.

    Args:
        image_noise: standard normal noise, for pixels of the background.
        table: standard normal values of the cells.
        depth: of the renderer, along the optical axis.
    """
    height, width = image_noise.shape[-2:]
    grid = (SAMPLES * height, SAMPLES * width)
    c2w, fovy = c2w.float(), fovy.float()
    points = surface_points(_sampled(depth, grid), c2w, fovy)
    samples = _samples(cells(points, cell_size(c2w, fovy, height)))
    values = sum(table.index_select(0, sample.flatten()) for sample in samples)
    noise = (values / _deviation(samples).reshape(-1, 1)).unflatten(0, (-1, height, width))
    surface = _sampled(opacity, (height, width))[:, None] >= OPAQUE
    return torch.where(surface, noise.movedim(-1, 1).to(image_noise), image_noise)


def _sampled(images: Float[Tensor, "B H W 1"], size: tuple[int, int]) -> Float[Tensor, "B h w"]:
    """Return the nearest pixels; between an edge and what is behind it there is no surface."""
    return F.interpolate(images.movedim(-1, 1).float(), size, mode="nearest")[:, 0]


def _samples(hashed: Int[Tensor, "B H W"]) -> list[Int[Tensor, "B h w"]]:
    """Return the points of the pixels, by their place within a pixel."""
    return [
        hashed[:, row::SAMPLES, column::SAMPLES]
        for row in range(SAMPLES)
        for column in range(SAMPLES)
    ]


def _deviation(samples: list[Int[Tensor, "B h w"]]) -> Float[Tensor, "B h w"]:
    """Return the standard deviation of the sum of the samples' values: a pair of equal cells adds 2
    to the variance of different ones.
    """
    variance = torch.full(samples[0].shape, float(len(samples)), device=samples[0].device)
    for i, first in enumerate(samples):
        for second in samples[:i]:
            variance += 2 * (first == second)
    return variance.sqrt_()
