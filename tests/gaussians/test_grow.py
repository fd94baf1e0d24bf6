"""Algorithm 1 of the paper: growing, colour perturbation and initial scales, degenerate clouds
included.
"""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as np_strategies
from scipy.spatial import cKDTree

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.grow import (
    grow,
    growing_box,
    longest_side,
    nearest_distance_scales,
)
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud

FINITE = st.floats(width=32, allow_nan=False, allow_infinity=False)


def rng(seed=0):
    return np.random.default_rng(seed)


def sphere(count=2000, seed=1):
    """Return a coloured unit sphere with its normals."""
    normals = rng(seed).normal(size=(count, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    return PointCloud(
        points=normals, colors=(normals * 0.3 + 0.4).astype(np.float32), normals=normals
    )


def moved(cloud, scale, shift=0.0):
    return cloud._replace(points=cloud.points.astype(np.float64) * scale + shift)


def algorithm_1(points, colors, num_candidates, radius, generator):
    """Follow the paper's pseudocode line by line, in the unit of the points."""
    low, high = points.min(0), points.max(0)
    grown, near = [], []
    for candidate in generator.uniform(low, high, size=(num_candidates, 3)):
        distances = np.linalg.norm(points - candidate, axis=1)
        nearest = distances.argmin()
        if distances[nearest] < radius:
            grown.append(candidate)
            near.append(nearest)
    noise = 0.2 * generator.uniform(0, 1, size=(len(near), 3))
    return np.concatenate([points, grown]), np.concatenate([colors, colors[near] + noise])


class TestGrow:
    def test_equals_the_pseudocode_of_the_paper(self):
        cloud = sphere(300)
        unit = longest_side(cloud.points)
        points, colors = algorithm_1(
            cloud.points.astype(np.float64), cloud.colors, 2000, 0.1 * unit, rng(3)
        )
        grown = grow(
            cloud,
            num_candidates=2000,
            radius=0.1,
            color_range=(0.0, 0.2),
            clamp=False,
            generator=rng(3),
        )
        assert len(grown.points) > 350
        np.testing.assert_allclose(grown.points, points, atol=1e-7)  # one rounding to float32
        np.testing.assert_allclose(grown.colors, colors, atol=1e-7)

    def test_the_papers_radius_grows_what_the_released_code_grows(self):
        """The released code keeps candidates nearer than 0.01, in units in which the longest side
        of Shap-E's objects is 1; half of that radius would keep a fifth as many.
        """
        points = (sphere(8000).points * np.float32([0.5, 0.4, 0.3])).astype(np.float64)
        points /= np.ptp(points, axis=0).max()
        cloud = PointCloud(points, np.full((8000, 3), 0.5, np.float32))
        candidates = rng(3).uniform(points.min(0), points.max(0), (100_000, 3))
        distances, _ = cKDTree(points).query(candidates)
        grown = grow(cloud, num_candidates=100_000, radius=0.01, generator=rng(3)).points[8000:]
        assert 4000 < len(grown) < 4700
        np.testing.assert_array_equal(grown, candidates[distances < 0.01].astype(np.float32))

    def test_originals_come_first_and_unchanged(self):
        cloud = sphere()._replace(faces=np.array([[0, 1, 2]]))
        grown = grow(cloud, num_candidates=5000, radius=0.05, generator=rng())
        np.testing.assert_array_equal(grown.points[:2000], cloud.points)
        np.testing.assert_array_equal(grown.colors[:2000], cloud.colors)
        np.testing.assert_array_equal(grown.normals[:2000], cloud.normals)
        np.testing.assert_array_equal(grown.faces, cloud.faces)
        assert len(grown.normals) == len(grown.points) > 2000
        assert grown.points.dtype == grown.colors.dtype == np.float32

    def test_grown_points_lie_within_the_radius(self):
        cloud = sphere()
        grown = (
            grow(cloud, num_candidates=20_000, radius=0.05, generator=rng())
            .points[2000:]
            .astype(np.float64)
        )
        distances = np.linalg.norm(grown[:, None] - cloud.points[None], axis=2).min(axis=1)
        assert (
            distances.max() < 0.05 * longest_side(cloud.points) + 1e-6
        )  # the point was rounded to float32

    @pytest.mark.parametrize("scale, shift", [(1e-3, 0.0), (1e3, 0.0), (1.0, 1e4), (1e3, -1e7)])
    def test_unit_and_position_do_not_matter(self, scale, shift):
        options = dict(num_candidates=50_000, radius=0.03)
        expected = len(grow(sphere(), **options, generator=rng()).points) - 2000
        count = len(grow(moved(sphere(), scale, shift), **options, generator=rng()).points) - 2000
        assert abs(count / expected - 1) < 0.01  # the bar of stability.md A2

    def test_no_grown_point_returns_the_points_alone(self):
        corners = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1]), np.float32).reshape(3, -1).T
        cloud = PointCloud(points=corners, colors=np.full((8, 3), 0.5, np.float32))
        grown = grow(cloud, num_candidates=10_000, radius=0.005, generator=rng())
        np.testing.assert_array_equal(grown.points, corners)
        np.testing.assert_array_equal(grown.colors, cloud.colors)

    def test_no_candidates_means_no_growing(self):
        assert len(grow(sphere(), num_candidates=0, radius=0.1, generator=rng()).points) == 2000

    @pytest.mark.parametrize(
        "flat_axes", [(2,), (0, 1), (0, 1, 2)], ids=["plane", "needle", "point"]
    )
    def test_a_flat_cloud_grows_a_slab_up_to_the_cap(self, flat_axes):
        points = rng(1).uniform(-1, 1, (500, 3)).astype(np.float32)
        points[:, flat_axes] = 0.25
        cloud = PointCloud(points=points, colors=np.full((500, 3), 0.5, np.float32))
        grown = grow(
            cloud, num_candidates=20_000, radius=0.05, max_points=1000, generator=rng()
        ).points[500:]
        reach = 0.05 * (longest_side(points) or 1.0)
        assert len(grown) == 1000
        assert np.abs(grown[:, flat_axes] - 0.25).max() < reach * 1.0001
        assert (
            grown[:, flat_axes].std(axis=0) > reach / 4
        ).all()  # a uniform slab has reach / sqrt(3)

    def test_the_box_of_a_solid_cloud_is_not_padded(self):
        points = sphere().points.astype(np.float64)
        low, high = growing_box(points, 0.01)
        np.testing.assert_array_equal(low, points.min(0))
        np.testing.assert_array_equal(high, points.max(0))

    def test_the_cap_is_exact_and_keeps_a_uniform_choice(self):
        options = dict(num_candidates=50_000, radius=0.05)
        everything = grow(sphere(), **options, generator=rng()).points[2000:]
        kept = grow(sphere(), **options, max_points=1000, generator=rng()).points[2000:]
        assert len(kept) == 1000 < len(everything)
        # Three standard errors of the mean of 1000 draws: no side of the cloud is preferred.
        np.testing.assert_allclose(
            kept.mean(0), everything.mean(0), atol=3 * everything.std() / np.sqrt(1000)
        )
        assert len(grow(sphere(), **options, max_points=0, generator=rng()).points) == 2000

    def test_same_generator_same_cloud_and_the_global_one_is_unchanged(self):
        before = np.random.get_state()[1].copy()
        first, again, other = (
            grow(sphere(), num_candidates=5000, radius=0.05, generator=rng(seed))
            for seed in (7, 7, 8)
        )
        np.testing.assert_array_equal(first.points, again.points)
        np.testing.assert_array_equal(first.colors, again.colors)
        assert not np.array_equal(first.points[2000:2010], other.points[2000:2010])
        np.testing.assert_array_equal(before, np.random.get_state()[1])

    @pytest.mark.parametrize("color_range, mean", [((0.0, 0.2), 0.1), ((-0.1, 0.1), 0.0)])
    def test_colour_noise_is_uniform_in_its_range(self, color_range, mean):
        cloud = sphere()._replace(colors=np.full((2000, 3), 0.5, np.float32))
        grown = grow(
            cloud, num_candidates=50_000, radius=0.05, color_range=color_range, generator=rng()
        )
        noise = grown.colors[2000:] - 0.5
        assert noise.min() >= color_range[0] - 1e-6 and noise.max() <= color_range[1] + 1e-6
        assert noise.mean() == pytest.approx(
            mean, abs=4 * 0.0577 / np.sqrt(noise.size)
        )  # std of U(0, 0.2): 0.0577
        assert noise.std() == pytest.approx(0.0577, rel=0.02)

    def test_clamp_is_an_option(self):
        cloud = sphere()._replace(colors=np.full((2000, 3), 0.95, np.float32))
        clamped, free = (
            grow(cloud, num_candidates=20_000, radius=0.05, clamp=clamp, generator=rng()).colors
            for clamp in (True, False)
        )
        assert clamped.max() == 1.0 and free.max() > 1.1

    def test_copies_in_the_cloud_cost_nothing(self):
        cloud = PointCloud(
            points=np.zeros((50_000, 3), np.float32), colors=np.full((50_000, 3), 0.5, np.float32)
        )
        grown = grow(
            cloud, num_candidates=20_000, radius=0.1, generator=rng()
        )  # copy by copy: 1e9 distances
        assert len(grown.points) > 55_000

    @pytest.mark.parametrize(
        "option",
        [
            dict(radius=0.0),
            dict(radius=float("nan")),
            dict(color_range=(0.2, 0.0)),
            dict(num_candidates=-1),
            dict(max_points=-1),
        ],
    )
    def test_bad_options_are_named(self, option):
        with pytest.raises(UserError, match="radius|color_range|num_candidates|max_points"):
            grow(sphere(), **{**dict(num_candidates=10, radius=0.1), **option}, generator=rng())

    def test_bad_clouds_are_refused(self):
        empty = PointCloud(points=np.zeros((0, 3), np.float32), colors=np.zeros((0, 3), np.float32))
        with pytest.raises(UserError, match="no points"):
            grow(empty, generator=rng())
        with pytest.raises(UserError, match="1 of 2000 points are NaN"):
            points = sphere().points.copy()
            points[5, 1] = np.nan
            grow(sphere()._replace(points=points), generator=rng())


class TestNearestDistanceScales:
    @pytest.mark.parametrize("rule, neighbours", [("nearest", 1), ("rms3", 3)])
    def test_equals_brute_force(self, rule, neighbours):
        points = rng().uniform(-1, 1, (200, 3))
        distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[
            :, 1 : neighbours + 1
        ]
        scales = nearest_distance_scales(points, rule)
        np.testing.assert_allclose(scales, np.sqrt((distances**2).mean(1)), rtol=1e-6)  # float32
        assert scales.dtype == np.float32

    def test_copies_get_the_median_of_the_distinct_points(self):
        points = rng().uniform(-1, 1, (200, 3))
        doubled = np.concatenate([points, points[:100]])
        scales, alone = nearest_distance_scales(doubled), nearest_distance_scales(points)
        np.testing.assert_allclose(scales[:100], np.median(alone), rtol=1e-6)
        np.testing.assert_array_equal(scales[200:], scales[:100])
        np.testing.assert_array_equal(scales[100:200], alone[100:])

    def test_minus_zero_equals_zero(self):
        points = rng().uniform(-1, 1, (10, 3))
        points[0], points[1] = 0.0, -0.0
        assert nearest_distance_scales(points).min() > 1e-3

    def test_copies_that_differ_by_rounding_are_not_specks(self):
        points = rng().uniform(-1, 1, (500, 3))
        scales = nearest_distance_scales(np.concatenate([points, points + 1e-15]))
        assert scales.min() >= 0.9e-4 * np.median(scales)

    @pytest.mark.parametrize("count", [20, 1000])
    def test_an_isolated_point_is_capped(self, count):
        points = rng().uniform(-1, 1, (count, 3))
        usual = np.quantile(nearest_distance_scales(points), 0.99)
        scales = nearest_distance_scales(np.concatenate([points, [[1000.0, 0, 0]]]))
        assert usual < scales[-1] <= 10.001 * scales[:-1].max()

    @pytest.mark.parametrize("rule", ["nearest", "rms3"])
    @pytest.mark.parametrize("count", [1, 2, 3])
    def test_fewer_than_four_points_get_a_fraction_of_their_extent(self, rule, count):
        points = np.array([[0, 0, 0], [2, 0, 0], [1, 0, 0]], float)[:count] * 5
        scales = nearest_distance_scales(points, rule)
        np.testing.assert_allclose(scales, 0.1 * (1.0 if count == 1 else 5.0))

    @pytest.mark.parametrize("rule", ["nearest", "rms3"])
    def test_all_equal_points(self, rule):
        scales = nearest_distance_scales(
            np.ones((100_000, 3)), rule
        )  # with a quadratic search: hours
        assert np.isfinite(scales).all() and (scales == scales[0]).all() and scales[0] > 0

    def test_half_copies_of_one_place(self):
        points = np.concatenate([rng().uniform(-1, 1, (30_000, 3)), np.zeros((30_000, 3))])
        scales = nearest_distance_scales(points, "rms3")
        np.testing.assert_allclose(scales[30_000:], np.median(scales[:30_000]), rtol=0.01)

    @settings(max_examples=60, deadline=None)
    @given(
        points=np_strategies.arrays(
            np.float32, st.tuples(st.integers(1, 12), st.just(3)), elements=FINITE
        ),
        rule=st.sampled_from(["nearest", "rms3"]),
    )
    def test_always_positive_and_finite(self, points, rule):
        scales = nearest_distance_scales(points, rule)
        assert scales.shape == (len(points),) and np.isfinite(scales).all() and (scales > 0).all()

    def test_scales_follow_the_unit(self):
        points = rng().uniform(-1, 1, (100, 3))
        np.testing.assert_allclose(
            nearest_distance_scales(points * 1e-3),
            nearest_distance_scales(points) * 1e-3,
            rtol=1e-5,
        )

    def test_mistakes_are_named(self):
        with pytest.raises(UserError, match="'nearst': did you mean 'nearest'"):
            nearest_distance_scales(np.zeros((5, 3)), "nearst")
        with pytest.raises(UserError, match="no points"):
            nearest_distance_scales(np.zeros((0, 3)))
