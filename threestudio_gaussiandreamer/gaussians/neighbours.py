"""Nearest neighbours among millions of points.

SciPy's k-d tree is several times faster if points that are stored or looked up one after the other
are near each other, so points and queries are sorted by the cells of a grid first. Queries run in
chunks, which bounds the memory of their results."""

from collections.abc import Iterator

import numpy as np
from jaxtyping import Float, Int

CELLS = 64
"""Cells of the grid along each side of the points' box."""
SAMPLES = 10_000
"""Points from which the box is estimated."""
QUERIES_AT_ONCE = 2**18


class NeighbourSearch:
    """Finds the nearest of P points.

    Args:
        points: (P, 3) float64, finite, P >= 1.
    """

    def __init__(self, points: Float[np.ndarray, "P 3"]) -> None:
        from scipy.spatial import cKDTree

        self.order = spatial_order(points)
        self.tree = cKDTree(points[self.order])

    def of_points(
        self, count: int
    ) -> Iterator[tuple[Int[np.ndarray, " Q"], Float[np.ndarray, "Q K"], Int[np.ndarray, "Q K"]]]:
        """Yield, in chunks, rows of points, and the distances and the rows of the ``count`` <= P
        points nearest to each; the first is the point itself, at 0.
        """
        for start in range(0, len(self.order), QUERIES_AT_ONCE):
            chunk = slice(start, start + QUERIES_AT_ONCE)
            places = range(1, count + 1)  # a range, so that K = 1 keeps its dimension
            distances, found = self.tree.query(self.tree.data[chunk], k=places, workers=-1)
            yield self.order[chunk], distances, self.order[found]

    def nearest(
        self, queries: Float[np.ndarray, "Q 3"], reach: float
    ) -> tuple[Float[np.ndarray, " Q"], Int[np.ndarray, " Q"]]:
        """Return distance and row of the nearest point; infinity and -1 if beyond ``reach``."""
        distances, nearest = np.empty(len(queries)), np.empty(len(queries), np.int64)
        rows = np.append(self.order, -1)  # the tree gives P where there is none
        order = spatial_order(queries) if len(queries) else np.empty(0, np.int64)
        for start in range(0, len(queries), QUERIES_AT_ONCE):
            chunk = order[start : start + QUERIES_AT_ONCE]
            distances[chunk], found = self.tree.query(
                queries[chunk], distance_upper_bound=reach, workers=-1
            )
            nearest[chunk] = rows[found]
        return distances, nearest


def spatial_order(points: Float[np.ndarray, "P 3"]) -> Int[np.ndarray, " P"]:
    """Return an order of at least one point in which neighbours mostly follow one another."""
    sample = points[:: max(1, len(points) // SAMPLES)]
    low, high = np.quantile(sample, (0.01, 0.99), axis=0)  # some points may lie far away
    size = np.where(high > low, high - low, 1.0)
    with np.errstate(over="ignore"):
        cells = ((points - low) / size * CELLS).clip(0, CELLS - 1).astype(np.int32)
    return np.argsort(np.ravel_multi_index(tuple(cells.T), (CELLS,) * 3), kind="stable")
