"""Algorithm 1 of the paper: growing, colour perturbation and initial scales."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_strategies

from threestudio_gaussiandreamer.gaussians import neighbours
from threestudio_gaussiandreamer.gaussians.grow import grow, longest_side, nearest_distance_scales
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud

FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)
POINTS = st.tuples(st.integers(1, 12), st.just(3))


def rng(seed=0):
    return np.random.default_rng(seed)


def sphere(count=2000, seed=1):
    """Return a coloured unit sphere with its normals."""
    normals = rng(seed).normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    return PointCloud(normals, (normals * 0.3 + 0.4).astype(np.float32), normals=normals)


def grown(cloud, candidates, radius, seed=0, **options):
    found = grow(cloud, num_candidates=candidates, radius=radius, generator=rng(seed), **options)
    return found.split(len(cloud.points))[1]


def algorithm_1(points, colors, num_candidates, radius, generator):
    """Follow the paper's pseudocode line by line, in the unit of the points."""
    low, high = points.min(0), points.max(0)
    found, near = [], []
    for candidate in generator.uniform(low, high, size=(num_candidates, 3)):
        distances = np.linalg.norm(points - candidate, axis=1)
        nearest = distances.argmin()
        if distances[nearest] < radius:
            found.append(candidate)
            near.append(nearest)
    return np.array(found), colors[near] + 0.2 * generator.uniform(0, 1, size=(len(near), 3))


def test_equals_the_pseudocode_of_the_paper(monkeypatch):
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 50)
    cloud = sphere(300)
    radius = 0.1 * longest_side(cloud.points)
    points, colors = algorithm_1(cloud.points.astype(float), cloud.colors, 2000, radius, rng(3))
    found = grown(cloud, 2000, 0.1, seed=3, clamp=False)
    assert len(found.points) > 50
    np.testing.assert_allclose(found.points, points, atol=1e-7)  # one rounding to float32
    np.testing.assert_allclose(found.colors, colors, atol=1e-7)
    again, other = (grown(cloud, 2000, 0.1, seed=seed) for seed in (3, 4))
    np.testing.assert_array_equal(found.points, again.points)
    assert not np.array_equal(found.points[:10], other.points[:10])


def test_originals_come_first_and_the_cap_keeps_a_uniform_choice():
    cloud = sphere()._replace(faces=np.array([[0, 1, 2]]))
    found = grow(cloud, num_candidates=5000, radius=0.05, generator=rng())
    for name in ("points", "colors", "normals"):
        np.testing.assert_array_equal(getattr(found, name)[:2000], getattr(cloud, name))
    np.testing.assert_array_equal(found.faces, cloud.faces)
    assert len(found.normals) == len(found.points) > 2000
    assert found.points.dtype == found.colors.dtype == np.float32
    assert len(grown(cloud, 0, 0.1).points) == 0
    everything, kept = grown(sphere(), 50_000, 0.05), grown(sphere(), 50_000, 0.05, max_points=1000)
    assert len(kept.points) == 1000 < len(everything.points)
    # Three standard errors of the mean of 1000 draws: no side of the cloud is preferred.
    error = 3 * everything.points.std() / np.sqrt(1000)
    np.testing.assert_allclose(kept.points.mean(0), everything.points.mean(0), atol=error)
    assert len(grown(sphere(), 50_000, 0.05, max_points=0).points) == 0


@pytest.mark.parametrize("dimensions", [3, 2, 1])
@pytest.mark.parametrize("rule, count", [("nearest", 1), ("rms3", 3)])
def test_scales_equal_brute_force(rule, count, dimensions, monkeypatch):
    """Also of points in a plane and on a line, in several parts."""
    monkeypatch.setattr(neighbours, "QUERIES_AT_ONCE", 50)
    points = rng().uniform(-1, 1, (200, 3))
    points[:, dimensions:] = 0.25
    distances = np.linalg.norm(points[:, None] - points[None], axis=2)
    nearest = np.sort(distances, axis=1)[:, 1 : count + 1]
    scales = nearest_distance_scales(points, rule)
    np.testing.assert_allclose(scales, np.sqrt((nearest**2).mean(1)), rtol=1e-6)  # float32
    assert scales.dtype == np.float32
    thousandth = nearest_distance_scales(points * 1e-3, rule)
    np.testing.assert_allclose(thousandth, scales * 1e-3, rtol=1e-5)


def test_copies_get_the_median_of_the_distinct_points():
    points = rng().uniform(-1, 1, (200, 3))
    rounded = nearest_distance_scales(np.concatenate([points, points + 1e-15]))
    assert rounded.min() >= 0.9e-4 * np.median(rounded)  # no specks
    points[0], points[1] = 0.0, -0.0
    assert nearest_distance_scales(points[:10]).min() > 1e-3
    half = np.concatenate([rng().uniform(-1, 1, (30_000, 3)), np.zeros((30_000, 3))])
    scales = nearest_distance_scales(half, "rms3")
    np.testing.assert_allclose(scales[30_000:], np.median(scales[:30_000]), rtol=0.01)


@settings(max_examples=60, deadline=None)
@given(
    points=np_strategies.arrays(np.float32, POINTS, elements=FINITE),
    rule=st.sampled_from(["nearest", "rms3"]),
)
def test_scales_are_always_positive_and_finite(points, rule):
    scales = nearest_distance_scales(points, rule)
    assert scales.shape == (len(points),) and np.isfinite(scales).all() and (scales > 0).all()
