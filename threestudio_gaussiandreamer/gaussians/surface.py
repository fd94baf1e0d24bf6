"""Extract the surface of Gaussians as a mesh with coloured vertices.

The opacity is summed on a grid of cells of side h,

    d(x) = sum_i o_i exp(-1/2 (x - m_i)^T (S_i + h^2 I)^-1 (x - m_i)),

where h^2 widens Gaussians smaller than a cell enough to be sampled by the grid. The surface is the
level set of d at a fraction of its median over the centres of the Gaussians. Surface nets (Gibson
1998) give one vertex for each cell that it crosses, at the mean of the crossings of its edges, and
one quad around each edge that is crossed. The mesh is closed, and thicker than the object by about
sqrt(s^2 + h^2), where s is the Gaussians' standard deviation across it."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.tensors import rotation_rows
from .gaussians import Gaussians, opaque
from .sh import sh0_colors

REACH = 3.0
"""Standard deviations beyond which a Gaussian is ignored: exp(-4.5) is 1 %."""
MIN_OPACITY = 0.02
"""Gaussians with a lower opacity are left out."""
HALF_HEIGHT = 1.25
"""Standard deviations within which the surface of a single Gaussian lies: half is at 1.18."""
NODES_AT_ONCE = 4_000_000
SMALL = 8
"""Reach of a Gaussian, in cells, up to which many are added at once, larger ones one by one."""
MARGIN = 3
"""Cells around the cloud, of which the outermost are empty, so that the surface closes."""


class Surface(NamedTuple):
    """A triangle mesh with coloured vertices; normals point outwards."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    colors: Float[np.ndarray, "V 3"]

    def rotated(self, rotation: Float[np.ndarray, "3 3"]) -> "Surface":
        """Rotate about the origin."""
        return self._replace(vertices=self.vertices @ rotation.T)


def gaussian_surface(gaussians: Gaussians, *, resolution: int = 128, level: float = 0.5) -> Surface:
    """Extract the surface, in the Gaussians' units; empty where no Gaussian is visible.

    Args:
        resolution: cells along the longest side of the Gaussians' box.
        level: share of the summed opacity's median at the centres, in (0, 1]; lower is thicker.
    """
    visible = opaque(gaussians, MIN_OPACITY)
    if not visible.any():
        return Surface(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros((0, 3)))
    gaussians = gaussians.rows(visible)
    covariances = covariance_matrices(gaussians)
    size = HALF_HEIGHT * np.sqrt(covariances[:, range(3), range(3)])
    low, high = (gaussians.means - size).min(axis=0), (gaussians.means + size).max(axis=0)
    cell = max(float((high - low).max()) / resolution, 1e-6)
    origin = low - MARGIN * cell
    shape = tuple(int(n) for n in np.ceil((high - low) / cell) + 2 * MARGIN + 1)
    density, colored = _summed(gaussians, covariances, origin, cell, shape)
    centers = np.round((gaussians.means - origin) / cell).astype(int)
    corners, faces = surface_nets(density, level * float(np.median(density[tuple(centers.T)])))
    # of each vertex the mean over its cell's corners, weighted by opacity
    cells = tuple(np.floor(corners).astype(int).T)
    total = sum(density[_corner(bits)][cells] for bits in range(8))
    color = sum(colored[_corner(bits)][cells] for bits in range(8))
    return Surface(corners * cell + origin, faces, (color / total[:, None]).clip(0, 1))


def surface_nets(
    values: Float[np.ndarray, "X Y Z"], level: float
) -> tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]:
    """Return the vertices, in cells, and triangles of a level set; below ``level`` is outside.

    The surface is open where values at the boundary of the grid are above ``level``.
    """
    inside = values > level
    count = sum(inside[_corner(bits)].astype(np.int8) for bits in range(8))
    cells = np.argwhere((count > 0) & (count < 8))
    number = np.full(count.shape, -1)
    number[tuple(cells.T)] = np.arange(len(cells))
    quads = np.concatenate([_quads(inside, number, axis) for axis in range(3)])
    return cells + _crossings(values, cells, level), quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)


def _summed(
    gaussians: Gaussians,
    covariances: Float[np.ndarray, "N 3 3"],
    origin: Float[np.ndarray, "3"],
    cell: float,
    shape: tuple[int, ...],
) -> tuple[Float[np.ndarray, "X Y Z"], Float[np.ndarray, "X Y Z 3"]]:
    """Sum opacity, and opacity times colour, at the nodes of a grid."""
    widened, ones = covariances + cell**2 * np.eye(3), np.ones((len(gaussians.means), 1))
    in_cells = _InCells(
        places=(gaussians.means - origin) / cell,
        precisions=np.moveaxis(np.linalg.inv(widened / cell**2), 0, -1),
        opacities=1 / (1 + np.exp(-gaussians.logit_opacities.astype(np.float64))),
        weights=np.concatenate([ones, sh0_colors(gaussians.sh[:, 0])], axis=1),
    )
    widest = np.sqrt(widened[:, range(3), range(3)].max(axis=1))
    half_sides = np.ceil(REACH * widest / cell).astype(int)
    sums = np.zeros((*shape, 4))
    for half_side in np.unique(half_sides[half_sides <= SMALL]):
        _add_many(sums, in_cells, np.flatnonzero(half_sides == half_side), int(half_side))
    for row in np.flatnonzero(half_sides > SMALL):
        _add_one(sums, in_cells, row, int(half_sides[row]))
    sums *= np.pad(np.ones(np.subtract(shape, 2)), 1)[..., None]
    return sums[..., 0], sums[..., 1:]


class _InCells(NamedTuple):
    """Gaussians in units of cells; ``weights``, times the opacity, are summed."""

    places: Float[np.ndarray, "N 3"]
    precisions: Float[np.ndarray, "3 3 N"]
    opacities: Float[np.ndarray, " N"]
    weights: Float[np.ndarray, "N 4"]


def _add_many(
    sums: Float[np.ndarray, "X Y Z 4"],
    gaussians: _InCells,
    rows: Int[np.ndarray, " M"],
    half_side: int,
) -> None:
    """Add Gaussians with the same extent in cells, up to ``NODES_AT_ONCE`` nodes at a time."""
    shape = np.array(sums.shape[:3])
    sides = np.meshgrid(*[np.arange(-half_side, half_side + 1)] * 3, indexing="ij")
    offsets = np.stack(sides, axis=-1).reshape(-1, 3)
    flat = sums.reshape(-1, 4)
    for chunk in np.array_split(rows, -(-len(rows) * len(offsets) // NODES_AT_ONCE)):
        nodes = np.round(gaussians.places[chunk]).astype(int)[:, None] + offsets
        away = np.moveaxis((nodes - gaussians.places[chunk, None]).astype(np.float32), -1, 0)
        falloff = _falloff(away, gaussians.precisions[:, :, chunk, None])
        opacity = gaussians.opacities[chunk, None] * falloff
        opacity *= ((nodes >= 0) & (nodes < shape)).all(axis=-1)
        places = tuple(np.moveaxis(nodes, -1, 0))
        index = np.ravel_multi_index(places, tuple(shape), mode="clip").ravel()
        for channel in range(4):
            added = opacity * gaussians.weights[chunk, channel, None]
            flat[:, channel] += np.bincount(index, added.ravel(), minlength=len(flat))


def _add_one(sums: Float[np.ndarray, "X Y Z 4"], gaussians: _InCells, row: int, half: int) -> None:
    """Add one Gaussian of any size."""
    place, shape = gaussians.places[row], np.array(sums.shape[:3])
    first, last = (np.round(place).astype(int) + sign * half for sign in (-1, 1))
    box = tuple(slice(a, b) for a, b in zip(first.clip(0), (last + 1).clip(0, shape), strict=True))
    away = np.ogrid[box]
    away = [(axis - at).astype(np.float32) for axis, at in zip(away, place, strict=True)]
    opacity = gaussians.opacities[row] * _falloff(away, gaussians.precisions[:, :, row])
    sums[box] += opacity[..., None] * gaussians.weights[row]


def _falloff(away: Sequence[np.ndarray], precision: Float[np.ndarray, "3 3 *k"]) -> np.ndarray:
    """Compute exp(-1/2 d^T P d) from the three components of d."""
    x, y, z = away
    xx, xy, xz, yy, yz, zz = (
        precision[i, j].astype(np.float32)
        for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    )
    return np.exp(
        -0.5 * (x * (xx * x + 2 * (xy * y + xz * z)) + y * (yy * y + 2 * yz * z) + zz * z * z)
    )


def covariance_matrices(gaussians: Gaussians) -> Float[np.ndarray, "N 3 3"]:
    lengths = np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    unit = (gaussians.quats / np.maximum(lengths, 1e-12)).T.astype(np.float64)
    axes = np.moveaxis(np.array(rotation_rows(*unit)), -1, 0)
    scaled = axes * np.exp(gaussians.log_scales.astype(np.float64))[:, None]
    return scaled @ scaled.transpose(0, 2, 1)


def _corner(bits: int) -> tuple[slice, ...]:
    """Select corner x + 2 y + 4 z of each cell of a grid of nodes."""
    return tuple(slice(1, None) if bits >> axis & 1 else slice(None, -1) for axis in range(3))


def _crossings(
    values: Float[np.ndarray, "X Y Z"], cells: Int[np.ndarray, "V 3"], level: float
) -> Float[np.ndarray, "V 3"]:
    """Return the mean position, within each cell, of the crossings on its edges."""
    place, count = np.zeros((len(cells), 3)), np.zeros(len(cells))
    at = [values[_corner(bits)][tuple(cells.T)] for bits in range(8)]
    for start in range(8):
        for axis in range(3):
            if start >> axis & 1:
                continue
            first, last = at[start], at[start | 1 << axis]
            crossed = (first > level) != (last > level)
            along = (level - first[crossed]) / (last[crossed] - first[crossed])
            place[crossed] += [start >> other & 1 for other in range(3)]
            place[crossed, axis] += along
            count += crossed
    return place / np.maximum(count, 1)[:, None]


def _quads(
    inside: np.ndarray, number: Int[np.ndarray, "x y z"], axis: int
) -> Int[np.ndarray, "Q 4"]:
    """Return the cells around each crossed edge along ``axis``, counterclockwise from outside."""
    u, v = (axis + 1) % 3, (axis + 2) % 3
    along = np.moveaxis(inside, (axis, u, v), (0, 1, 2))[:, 1:-1, 1:-1]
    cells = np.moveaxis(number, (axis, u, v), (0, 1, 2))
    a, b, c = np.nonzero(along[:-1] != along[1:])
    around = ((b, c), (b + 1, c), (b + 1, c + 1), (b, c + 1))
    ring = np.stack([cells[a, i, j] for i, j in around], axis=1)
    backwards = ~along[a, b, c]  # the far end is inside, so outside lies towards -axis
    ring[backwards] = ring[backwards, ::-1]
    return ring
