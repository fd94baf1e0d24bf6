"""A z-buffer in plain numpy: which triangle a camera sees at every sample, where there is no ray
caster for it.

No triangle is divided by its depth. With corners a, b, c in camera coordinates and the ray d = (x,
y, -1), the three edge functions d . (b x c), d . (c x a), d . (a x b) all have the sign of det(a,
b, c) exactly where the ray meets the triangle in front of the camera; in proportion they are the
barycentric weights on the surface, and their sum over the determinant is 1 / depth (Olano and Greer
1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates"). So perspective is correct,
triangles through the plane of the camera need no clipping, and neighbours leave no gap: their
common edge has the same function up to its sign."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

NEAR = 1e-6
PAIRS_PER_STEP = 2**17
"""(triangle, sample) pairs that are tested at once: the arrays stay in the cache, and memory
doesn't grow with the picture.
"""
SLACK = 1e-6
"""Pixels around a triangle's box, so that its rounding never decides what the edge functions
should.
"""


class Triangles(NamedTuple):
    """What may be seen of a mesh in one picture."""

    face_index: Int[np.ndarray, " T"]
    edges: Float[np.ndarray, "T 3 3"]
    """The edge function opposite each corner as a vector to multiply the ray by, >= 0 inside, world
    units squared.
    """
    volume: Float[np.ndarray, " T"]
    """|det(a, b, c)|: the sum of the edge functions is volume / depth."""
    box: Int[np.ndarray, "T 4"]
    """First and last row, first and last column of the samples around it; the last ones are
    exclusive.
    """


class ZBuffer:
    """The visible faces of one triangle mesh, from both sides; for several threads."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self.vertices, self.faces = vertices.astype(np.float64), faces

    def hits(
        self,
        c2w: Float[np.ndarray, "4 4"],
        focal: float,
        rows: Float[np.ndarray, " H"],
        columns: Float[np.ndarray, " W"],
    ) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
        """Return the nearest face at each sample, -1 = none, and the weights of its three corners
        (0 where there is none).

        Args:
            c2w: OpenGL camera to world.
            focal: pixels.
            rows, columns: ascending places of the samples in pixels from the centre of the picture,
                rows downwards.
        """
        rays = _Rays(-rows / focal, columns / focal)
        corners = ((self.vertices - c2w[:3, 3]) @ c2w[:3, :3])[self.faces]
        triangles = _triangles(corners, focal, rows, columns)
        nearest = np.full(len(rows) * len(columns), -1)
        inverse_depth = np.zeros(len(nearest))
        for triangle, sample in _pairs(triangles.box, len(columns)):
            _draw(triangles, rays, triangle, sample, nearest, inverse_depth)
        return _weights(triangles, rays, nearest)


class _Rays(NamedTuple):
    """The rays (x, y, -1) through the samples, in camera coordinates."""

    y: Float[np.ndarray, " H"]
    x: Float[np.ndarray, " W"]

    def times(
        self, edge: Float[np.ndarray, "P 3"], sample: Int[np.ndarray, " P"]
    ) -> Float[np.ndarray, " P"]:
        row, column = np.divmod(sample, len(self.x))
        return self.x[column] * edge[:, 0] + self.y[row] * edge[:, 1] - edge[:, 2]


def _triangles(
    corners: Float[np.ndarray, "F 3 3"], focal: float, rows: np.ndarray, columns: np.ndarray
) -> Triangles:
    """Return the triangles that cover a sample's place with their box and aren't seen from the
    edge.
    """
    box = _boxes(corners, focal, rows, columns)
    index = np.flatnonzero((box[:, 0] < box[:, 1]) & (box[:, 2] < box[:, 3]))
    a, b, c = np.moveaxis(corners[index], 1, 0)
    edges = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    volume = np.einsum("tc,tc->t", a, edges[:, 0])
    edges *= np.sign(volume)[:, None, None]
    seen = volume != 0
    return Triangles(index[seen], edges[seen], np.abs(volume[seen]), box[index[seen]])


def _boxes(
    corners: Float[np.ndarray, "F 3 3"], focal: float, rows: np.ndarray, columns: np.ndarray
) -> Int[np.ndarray, "F 4"]:
    """Return the samples around each triangle: (first row, end, first column, end), empty where it
    is behind the camera.
    """
    points = _in_front(corners)
    with np.errstate(invalid="ignore"):  # NaN is a point that isn't there
        across, down = (
            focal * points[..., 0] / -points[..., 2],
            focal * points[..., 1] / points[..., 2],
        )
    spans = [
        (rows, np.fmin.reduce(down, 1), np.fmax.reduce(down, 1)),
        (columns, np.fmin.reduce(across, 1), np.fmax.reduce(across, 1)),
    ]
    ends = [
        (np.searchsorted(places, low - SLACK), np.searchsorted(places, high + SLACK, "right"))
        for places, low, high in spans
    ]
    box = np.stack([ends[0][0], ends[0][1], ends[1][0], ends[1][1]], axis=1)
    box[np.isnan(spans[0][1])] = 0
    return box


def _in_front(corners: Float[np.ndarray, "F 3 3"]) -> Float[np.ndarray, "F P 3"]:
    """Return the corners of what lies beyond the near plane: of those before it the NaN, and where
    edges cross it the crossings.
    """
    behind = -corners[..., 2] < NEAR
    if not behind.any():
        return corners
    following, depth = np.roll(corners, -1, axis=1), -corners[..., 2] - NEAR
    with np.errstate(invalid="ignore", divide="ignore"):
        along = depth / (depth - np.roll(depth, -1, axis=1))
    along[behind == np.roll(behind, -1, axis=1)] = np.nan
    crossings = corners + along[..., None] * (following - corners)
    return np.concatenate([np.where(behind[..., None], np.nan, corners), crossings], axis=1)


def _pairs(
    box: Int[np.ndarray, "T 4"], width: int
) -> Iterator[tuple[Int[np.ndarray, " P"], Int[np.ndarray, " P"]]]:
    """Return every (triangle, sample) with the sample in the triangle's box, a limited number at a
    time, in the triangles' order.
    """
    across = box[:, 3] - box[:, 2]
    ends = np.cumsum((box[:, 1] - box[:, 0]) * across)
    starts = np.concatenate([[0], ends[:-1]])
    for first in range(0, ends[-1] if len(ends) else 0, PAIRS_PER_STEP):
        last = min(first + PAIRS_PER_STEP, ends[-1])
        some = np.arange(np.searchsorted(ends, first, "right"), np.searchsorted(starts, last))
        triangle = np.repeat(some, np.minimum(ends[some], last) - np.maximum(starts[some], first))
        row, column = np.divmod(np.arange(first, last) - starts[triangle], across[triangle])
        yield triangle, (box[triangle, 0] + row) * width + box[triangle, 2] + column


def _draw(
    triangles: Triangles,
    rays: _Rays,
    triangle: Int[np.ndarray, " P"],
    sample: Int[np.ndarray, " P"],
    nearest: Int[np.ndarray, " S"],
    inverse_depth: Float[np.ndarray, " S"],
) -> None:
    """Put those pairs into the buffers (in place) that lie inside and nearer than what is there;
    the first of equals stays.
    """
    total = 0.0
    for corner in range(3):
        value = rays.times(triangles.edges[triangle, corner], sample)
        inside = value >= 0
        triangle, sample, total = triangle[inside], sample[inside], (total + value)[inside]
    value = total / triangles.volume[triangle]
    nearer = (value > inverse_depth[sample]) & (value < 1 / NEAR)
    triangle, sample, value = triangle[nearer], sample[nearer], value[nearer]
    np.maximum.at(inverse_depth, sample, value)
    best = np.flatnonzero(value == inverse_depth[sample])
    places, first = np.unique(sample[best], return_index=True)
    nearest[places] = triangle[best[first]]


def _weights(
    triangles: Triangles, rays: _Rays, nearest: Int[np.ndarray, " S"]
) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
    """Face indices and barycentric weights of the triangles that were seen."""
    sample = np.flatnonzero(nearest >= 0)
    edges = triangles.edges[nearest[sample]]
    values = np.stack([rays.times(edges[:, corner], sample) for corner in range(3)], axis=1)
    face_index, weights = np.full(len(nearest), -1), np.zeros((len(nearest), 3))
    face_index[sample] = triangles.face_index[nearest[sample]]
    weights[sample] = values / values.sum(axis=1, keepdims=True)
    shape = len(rays.y), len(rays.x)
    return face_index.reshape(shape), weights.reshape(*shape, 3)
