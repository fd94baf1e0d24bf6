"""Gaussian noise that is attached to surfaces, so that all views of a point see the same noise.

Space is divided into cubic cells, each with its own normal values of variance 1 / ``LATTICES``, one
per channel, in ``LATTICES`` ways that are shifted against each other. A pixel of the latent looks
up the cells of the point of the rendered surface at its centre, one per lattice; its noise is their
sum. Each pixel is thus standard normal, and pixels are independent unless they see the same cell.
A cell's size is a power of two, from half the distance of two such points at the origin to all of
it: views from similar distances share their cells.

The values stand in a table that a hash of the cell looks up. The pixels of the background look up
rows that change with each draw."""

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor

from ..cameras import focal_length, surface_points

LATTICES = 2
TABLE = 2**16
"""Rows of the table of values, a power of two."""
PRIMES = (73856093, 19349663, 83492791)
"""Of Teschner et al. (2003). Rows are sums of the products, modulo ``TABLE``: other than with their
exclusive or, cells that are near each other never share a row.
"""
ITEM = 61045
"""Distance between the rows of neighbouring items. Neither it nor its multiples up to 6 are a
distance between the rows of two pixels of 64 x 64: no item's background is another's, shifted.
"""
OPAQUE = 0.5
"""Alpha below which a pixel belongs to the background."""


def cell_values(channels: int, generator: torch.Generator) -> Float[Tensor, "c TABLE"]:
    """Draw the values of the cells."""
    return torch.randn(channels, TABLE, generator=generator) * LATTICES**-0.5


def surface_cells(
    points: Float[Tensor, "B 3 h w"], size: Float[Tensor, " B"]
) -> Int[Tensor, "L B h w"]:
    """Return a hash of each point's cell, for each lattice. Its row is the hash modulo ``TABLE``.

    Args:
        size: of the cells, world units: a power of two.
    """
    lattice = _counted(0, LATTICES, points.device)[:, None, None, None]
    shifts, per_unit = lattice[..., None] / LATTICES, size.reciprocal()[:, None, None, None]
    x, y, z = torch.addcmul(shifts, points, per_unit).floor_().int().unbind(2)
    # the last term makes the rows of one lattice differ from those of the others
    last = lattice * (TABLE // LATTICES)
    return last.add(x, alpha=PRIMES[0]).add_(y, alpha=PRIMES[1]).add_(z, alpha=PRIMES[2])


def background_cells(
    first: int, count: int, height: int, width: int, device: torch.device
) -> Int[Tensor, "L B h w"]:
    """Return a number for each lattice, item and pixel, from which its row follows in each step;
    ``first`` is the number of the first of ``count`` items.
    """
    lattices = _counted(0, LATTICES, device) * (TABLE // LATTICES)
    items = _counted(first, count, device) * ITEM
    rows, columns = (
        _counted(0, n, device) * prime for n, prime in zip((height, width), PRIMES, strict=False)
    )
    return lattices[:, None, None, None] + items[:, None, None] + rows[:, None] + columns


def _counted(first: int, count: int, device: torch.device) -> Int[Tensor, " n"]:
    return torch.arange(first, first + count, dtype=torch.int32, device=device)


def cell_size(c2w: Float[Tensor, "B 4 4"], focal: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the size of each view's cells, world units.

    Args:
        c2w: float32.
        focal: of the latents, pixels.
    """
    footprint = torch.linalg.vector_norm(c2w[:, :3, 3], dim=1) / focal
    bits = footprint.clamp_min_(1e-6).view(torch.int32)
    return bits.bitwise_and_(0x7F800000).view(torch.float32)  # only the exponent


def attached_noise(
    size: tuple[int, int],
    table: Float[Tensor, "c TABLE"],
    draw: int,
    first: int,
    depth: Float[Tensor, "B H W 1"],
    opacity: Float[Tensor, "B H W 1"],
    c2w: Float[Tensor, "B 4 4"],
    fovy: Float[Tensor, " B"],
) -> Float[Tensor, "B c h w"]:
    """Return standard normal noise, attached to the surface where there is one.

    Args:
        size: (h, w) of the latents.
        table: :func:`cell_values`.
        draw: random number in [0, TABLE), from which the background's noise in a step follows.
        first: number of the first item among those of all processes.
        depth: of the renderer, along the optical axis; renders needn't have the latents' aspect
            ratio, since models get them squeezed to a square.
    """
    c2w, focal = c2w.float(), focal_length(fovy.float(), size[0])
    aspect = (depth.shape[2] / depth.shape[1]) / (size[1] / size[0])
    points = surface_points(_sampled(depth, size), c2w, focal, aspect)
    cells = surface_cells(points, cell_size(c2w, focal))
    behind = background_cells(first, len(depth), *size, depth.device) + draw
    is_surface = _sampled(opacity, size) >= OPAQUE
    rows = torch.where(is_surface, cells, behind).bitwise_and_(TABLE - 1)
    values = table.index_select(1, rows.flatten()).view(-1, *rows.shape)
    noise = torch.empty(len(depth), len(table), *size, device=depth.device)
    torch.sum(values, 1, out=noise.transpose(0, 1))
    return noise


def _sampled(images: Float[Tensor, "B H W 1"], size: tuple[int, int]) -> Float[Tensor, "B h w"]:
    """Return the pixels nearest to the centres of h x w ones; edges aren't interpolated."""
    height, width = size
    if images.shape[1] % height == 0 == images.shape[2] % width:  # as below, but a view
        rows, columns = images.shape[1] // height, images.shape[2] // width
        return images[:, rows // 2 :: rows, columns // 2 :: columns, 0].float()
    return F.interpolate(images.movedim(-1, 1).float(), size, mode="nearest-exact")[:, 0]
