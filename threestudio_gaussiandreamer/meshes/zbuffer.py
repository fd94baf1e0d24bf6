"""A z-buffer in NumPy: finds the triangle that is visible at each sample, as a fallback where
embree isn't installed.

Triangles are rasterised in homogeneous coordinates, without a division by depth (Olano and Greer
1997, "Triangle Scan Conversion using 2D Homogeneous Coordinates"). With corners a, b, c in camera
coordinates and the ray d = (x, y, -1), the three edge functions d . (b x c), d . (c x a),
d . (a x b) all have the sign of det(a, b, c) exactly if the ray hits the triangle in front of the
camera. They are proportional to the barycentric weights, and their sum over the determinant is
1 / depth. Hence the interpolation is perspective-correct, triangles that cross the camera's plane
need no clipping, and adjacent triangles leave no gap, since their edge functions of the common edge
differ in sign only."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

NEAR = 1e-6
PAIRS_PER_STEP = 2**17
"""(triangle, sample) pairs that are tested at once, to bound the memory and use the CPU's cache."""
SLACK = 1e-6
"""Margin around a triangle's box in pixels, so that its rounding errors don't exclude samples that
the edge functions would include.
"""


class Triangles(NamedTuple):
    """The triangles of a mesh that may be visible in one image."""

    face_index: Int[np.ndarray, " T"]
    edges: Float[np.ndarray, "T 3 3"]
    """The edge function opposite each corner, as a vector whose dot product with the ray is >= 0
    inside; world units squared.
    """
    volume: Float[np.ndarray, " T"]
    """|det(a, b, c)|: the sum of the edge functions is volume / depth."""
    box: Int[np.ndarray, "T 4"]
    """The samples in the triangle's box: first row, end row, first column, end column; ends are
    exclusive.
    """


class ZBuffer:
    """Finds the visible faces of one triangle mesh, from both sides; thread-safe."""

    def __init__(self, vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"]) -> None:
        self.vertices, self.faces = vertices.astype(np.float64), faces

    def hits(
        self,
        c2w: Float[np.ndarray, "4 4"],
        focal: float,
        rows: Float[np.ndarray, " H"],
        columns: Float[np.ndarray, " W"],
    ) -> tuple[Int[np.ndarray, "H W"], Float[np.ndarray, "H W 3"]]:
        """Return the nearest face at each sample, -1 for none, and the weights of its three corners
        (0 for none).

        Args:
            c2w: OpenGL camera to world.
            focal: focal length, pixels.
            rows, columns: ascending coordinates of the samples in pixels relative to the image's
                centre, rows downwards.
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
    """Return the triangles whose box contains a sample and that aren't seen exactly edge-on."""
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
    """Return the box of samples around each triangle (first row, end, first column, end), empty for
    triangles behind the camera.
    """
    points = _in_front(corners)
    with np.errstate(invalid="ignore"):  # NaN marks a missing point
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
    """Clip triangles at the near plane: return their corners, NaN for those on the camera's side of
    it, and the points where edges cross it, NaN for edges that don't.
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
    """Yield all pairs (triangle, sample) with the sample in the triangle's box, in the order of the
    triangles, up to ``PAIRS_PER_STEP`` at a time.
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
    """Update the buffers in place with the pairs whose sample is inside the triangle and nearer
    than before; at equal depth the first triangle is kept.
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
    """Return the face indices and barycentric weights of the nearest triangles."""
    sample = np.flatnonzero(nearest >= 0)
    edges = triangles.edges[nearest[sample]]
    values = np.stack([rays.times(edges[:, corner], sample) for corner in range(3)], axis=1)
    face_index, weights = np.full(len(nearest), -1), np.zeros((len(nearest), 3))
    face_index[sample] = triangles.face_index[nearest[sample]]
    weights[sample] = values / values.sum(axis=1, keepdims=True)
    shape = len(rays.y), len(rays.x)
    return face_index.reshape(shape), weights.reshape(*shape, 3)
