"""The nearest neighbours are those of all distances."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.gaussians import neighbours
from threestudio_gaussiandreamer.gaussians.neighbours import NeighbourSearch


def cloud(count, dimensions=3, seed=0):
    """Return random points; those of fewer dimensions lie in a plane or on a line."""
    points = np.random.default_rng(seed).standard_normal((count, 3))
    points[:, dimensions:] = 0.25
    return points


def distances(queries, points):
    return np.linalg.norm(queries[:, None] - points, axis=2)


@pytest.mark.parametrize("dimensions", [3, 2, 1])
@pytest.mark.parametrize("count", [1, 4])
def test_the_neighbours_of_points_are_the_nearest(monkeypatch, dimensions, count):
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 50)
    points = cloud(170, dimensions)
    apart = distances(points, points)
    rows = []
    for some, found, nearest in NeighbourSearch(points).of_points(count):
        rows += some.tolist()
        assert np.allclose(found, np.sort(apart[some])[:, :count], atol=1e-15)
        assert np.allclose(apart[some[:, None], nearest], found, atol=1e-15)
    assert sorted(rows) == list(range(170))


def test_queries_beyond_the_reach_have_no_neighbour(monkeypatch):
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 50)
    points, queries = cloud(60), cloud(120, seed=1)
    apart = distances(queries, points)
    found, rows = NeighbourSearch(points).nearest(queries, 0.5)
    near = apart.min(axis=1) < 0.5
    assert 20 < near.sum() < 100
    assert np.array_equal(rows[near], apart.argmin(axis=1)[near])
    assert np.allclose(found[near], apart.min(axis=1)[near])
    assert np.isinf(found[~near]).all() and (rows[~near] == -1).all()
    assert len(NeighbourSearch(points).nearest(queries[:0], 0.5)[0]) == 0
