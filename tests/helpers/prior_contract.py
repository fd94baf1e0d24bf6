"""The contract of every prior, as a class of tests to subclass."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.base import Prior


def assert_valid(cloud):
    assert isinstance(cloud, PointCloud)
    assert cloud.points.dtype == cloud.colors.dtype == np.float32
    assert (
        cloud.points.shape == cloud.colors.shape == (len(cloud.points), 3) and len(cloud.points) > 0
    )
    assert np.isfinite(cloud.points).all() and cloud.colors.min() >= 0 and cloud.colors.max() <= 1
    if cloud.normals is not None:
        assert cloud.normals.shape == cloud.points.shape and cloud.normals.dtype == np.float32
        np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1, atol=1e-5)
    if cloud.faces is not None:
        assert (
            cloud.faces.shape[1:] == (3,)
            and 0 <= cloud.faces.min()
            and cloud.faces.max() < len(cloud.points)
        )


class PriorContract:
    """Subclass this with a fixture ``make_prior(**options)`` that builds the prior."""

    def test_gives_a_valid_cloud(self, make_prior):
        prior = make_prior()
        assert isinstance(prior, Prior)
        assert_valid(prior("a fox"))

    def test_same_seed_same_cloud_and_no_global_generator(self, make_prior, monkeypatch):
        monkeypatch.setenv("PL_GLOBAL_SEED", "5")
        before = np.random.get_state()[1].copy()
        first, again = (make_prior(ground=True)("a fox") for _ in range(2))
        for a, b in zip(first, again, strict=True):
            np.testing.assert_array_equal(a, b)
        np.testing.assert_array_equal(before, np.random.get_state()[1])
        monkeypatch.setenv("PL_GLOBAL_SEED", "6")
        assert not np.array_equal(make_prior(ground=True)("a fox").colors, first.colors)

    def test_ground_is_a_flat_layer_below_the_object(self, make_prior):
        alone = make_prior()("a fox")
        cloud = make_prior(ground=True, ground_points=4000, ground_size=2.0)("a fox")
        assert_valid(cloud)
        np.testing.assert_array_equal(cloud.points[:-4000], alone.points)
        ground, low, high = cloud.points[-4000:], alone.points.min(0), alone.points.max(0)
        np.testing.assert_array_equal(ground[:, 2], low[2])
        np.testing.assert_allclose(
            np.ptp(ground[:, :2], axis=0), 2 * (high - low).max(), rtol=0.01
        )  # 4000 draws reach the edge
        np.testing.assert_allclose(
            (ground[:, :2].min(0) + ground[:, :2].max(0)) / 2,
            (low + high)[:2] / 2,
            atol=0.01 * (high - low).max(),
        )
        assert cloud.colors[-4000:].std() == pytest.approx(
            np.sqrt(1 / 12), rel=0.05
        )  # uniform in [0, 1]
        assert (make_prior(ground=True, ground_height=-3)("").points[-1, 2]) == -3

    def test_unknown_options_are_refused(self, make_prior):
        with pytest.raises((UserError, TypeError), match="grond"):
            make_prior(grond=True)

    @pytest.mark.parametrize(
        "option", [{"ground_points": 0}, {"ground_size": -1.0}, {"ground_height": "low"}]
    )
    def test_options_out_of_range_are_refused_when_built(self, make_prior, option):
        with pytest.raises(UserError, match=next(iter(option))):
            make_prior(**option)
