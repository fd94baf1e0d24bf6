"""The contract of every prior, as a class of tests to subclass."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.base import Prior


def assert_valid(cloud):
    assert isinstance(cloud, PointCloud)
    shape = (len(cloud.points), 3)
    assert cloud.points.dtype == cloud.colors.dtype == np.float32
    assert cloud.points.shape == cloud.colors.shape == shape and len(cloud.points) > 0
    assert np.isfinite(cloud.points).all() and cloud.colors.min() >= 0 and cloud.colors.max() <= 1
    if cloud.normals is not None:
        assert cloud.normals.shape == shape and cloud.normals.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    if cloud.faces is not None:
        assert cloud.faces.shape[1:] == (3,)
        assert 0 <= cloud.faces.min() and cloud.faces.max() < len(cloud.points)


class PriorContract:
    """Subclass this with a fixture ``make_prior(**options)`` that builds the prior."""

    def test_gives_a_valid_cloud_of_its_seed_and_a_flat_layer_below(self, make_prior, monkeypatch):
        monkeypatch.setenv("PL_GLOBAL_SEED", "5")
        before = np.random.get_state()[1].copy()
        prior = make_prior()
        assert isinstance(prior, Prior)
        alone = prior("a fox")
        assert_valid(alone)
        grounded = make_prior(ground=True, ground_points=4000, ground_size=2.0)
        cloud, again = grounded("a fox"), grounded("a fox")
        assert_valid(cloud)
        for a, b in zip(cloud, again, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(before, np.random.get_state()[1])
        np.testing.assert_array_equal(cloud.points[:-4000], alone.points)
        ground, low, high = cloud.points[-4000:], alone.points.min(0), alone.points.max(0)
        side, places = (high - low).max(), ground[:, :2]
        np.testing.assert_array_equal(ground[:, 2], low[2])
        # 4000 draws reach the edge
        np.testing.assert_allclose(np.ptp(places, axis=0), 2 * side, rtol=0.01)
        middle = (places.min(0) + places.max(0)) / 2
        np.testing.assert_allclose(middle, (low + high)[:2] / 2, atol=0.01 * side)
        uniform = pytest.approx(np.sqrt(1 / 12), rel=0.05)
        assert cloud.colors[-4000:].std() == uniform
        monkeypatch.setenv("PL_GLOBAL_SEED", "6")
        assert not np.array_equal(grounded("a fox").colors, cloud.colors)

    def test_wrong_options_are_refused_when_built(self, make_prior):
        for option in ({"grond": True}, {"ground_points": 0}, {"ground_size": -1.0}):
            with pytest.raises((UserError, TypeError), match=next(iter(option))):
                make_prior(**option)
