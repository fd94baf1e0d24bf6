"""The contract of every kernel, as a class of tests to subclass: the float64 specification, on
ordinary and extreme clouds.
"""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.splatting_draws import BACKGROUND, compare, draw, repeatable
from tests.helpers.splatting_limits_contract import LimitsContract
from tests.helpers.splatting_scenes import (
    NAMES,
    NO_CUTOFFS,
    SINGLE,
    Cloud,
    cameras,
    error,
    extreme_cloud,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
    run,
    stacks_on_one_pixel,
    trimmed_error,
)


class KernelContract(LimitsContract):
    """Subclass this with a fixture ``backend`` that returns the name of a backend."""

    @pytest.mark.parametrize("width, height", [(1, 1), (1, 7), (17, 33), (31, 16), (67, 2)])
    def test_sizes_that_are_no_multiple_of_a_tile(self, backend, width, height):
        compare(
            backend,
            random_cloud(60, seed=width),
            cameras(2, width, height),
            width,
            height,
            BACKGROUND,
        )

    @pytest.mark.parametrize(
        "options",
        [
            {"preset": "fast"},
            {"preset": "accurate", "antialias": True},
            {"absgrad": True, "downsample": 2},
            {"absgrad": True, "antialias": True, "eps2d": 0.1},
            {"alpha_max": 0.6, "absgrad": True},
            {"stop": 0.2},
            NO_CUTOFFS,
            {
                "near": 2.9,
                "far": 3.2,
                "background": torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]]),
            },
        ],
        ids=str,
    )
    def test_options(self, backend, options):
        compare(backend, random_cloud(150, seed=1, size=0.2), cameras(2, 34, 18), 34, 18, **options)

    @pytest.mark.parametrize("downsample", [1, 2])
    def test_the_backgrounds_gradient_where_there_is_nothing_else(self, backend, downsample):
        """Most tiles have no Gaussian; a loss of alpha alone doesn't depend on the background."""
        cloud = random_cloud(3, seed=2, size=0.02).to(torch.float32).leaves()
        width, height = 150 * downsample, 90 * downsample
        camera = cameras(2, width, height, dtype=torch.float32)
        background = torch.tensor(BACKGROUND.tolist(), requires_grad=True)
        options = {"background": background, "backend": backend, "downsample": downsample}
        out = rasterize(*cloud, *camera, width, height, **options)
        upstream = torch.rand(out.image.shape, generator=torch.Generator().manual_seed(0))
        (found,) = torch.autograd.grad(out.image, background, upstream, retain_graph=True)
        expected = ((1 - out.alpha.detach().double()) * upstream).sum((0, 1, 2))
        torch.testing.assert_close(found.double(), expected, rtol=1e-5, atol=0)
        assert 0 < out.alpha.count_nonzero() < 0.1 * out.alpha.numel()
        (none,) = torch.autograd.grad(out.alpha.sum(), background, allow_unused=True)
        assert none is None or not none.any()

    @pytest.mark.parametrize("antialias", [False, True])
    def test_opacity_zero_has_a_gradient_without_alpha_min(self, backend, antialias):
        """``d alpha / d opacity`` is not zero at opacity 0; below zero nothing is rendered."""
        cloud = random_cloud(40, seed=8, size=0.2)
        cloud.opacities[::4], cloud.opacities[5] = 0, -0.1
        options = {"alpha_min": 0, "antialias": antialias}
        ours = compare(backend, cloud, cameras(2, 34, 18), 34, 18, **options)
        gradients = ours.grads["opacities"]
        assert gradients[::4].abs().min() > 1e-3 * gradients.abs().max() and gradients[5] == 0

    def test_a_few_thousand_gaussians(self, backend):
        """More than a chunk per tile, early termination, capped alphas; gradients of everything."""
        cloud = random_cloud(3000, seed=4, size=0.06)
        cloud.opacities[:150] = 0.9999
        options = {"preset": "fast", "absgrad": True}
        compare(backend, cloud, cameras(1, 66, 50), 66, 50, BACKGROUND, **options)

    def test_more_than_a_chunk_of_gaussians_over_whole_tiles(self, backend):
        """Faint ones, so that none is hidden; the CPU kernel keeps no lists of so many pairs."""
        cloud = random_cloud(600, seed=6, size=0.6)
        cloud.opacities.mul_(0.02)
        compare(backend, cloud, cameras(2, 34, 18), 34, 18, BACKGROUND, preset="accurate")

    def test_thousands_of_gaussians_on_hundreds_of_tiles(self, backend):
        """Against the torch backend in float64, which is exact and many times faster than the
        specification.
        """
        cloud, camera = random_cloud(8000, seed=5, size=0.02), cameras(2, 160, 144)
        truth = run(cloud, *camera, 160, 144, BACKGROUND, backend="torch")
        ours = draw(backend, cloud, camera, 160, 144, BACKGROUND)
        for name in (
            "image",
            "alpha",
            "depth",
        ):  # pixels in which two depths, or an alpha and its threshold, changed places
            assert (
                trimmed_error(
                    getattr(ours.out, name).flatten(0, 2), getattr(truth.out, name).flatten(0, 2)
                )
                < 2e-6
            ), name
        for name in NAMES:
            assert trimmed_error(ours.grads[name], truth.grads[name]) < SINGLE, name

    @pytest.mark.parametrize("channels", [1, 2, 5])
    @pytest.mark.parametrize("per_view", [False, True])
    def test_channels_shared_or_per_view(self, backend, channels, per_view):
        cloud = random_cloud(40, seed=2, channels=channels)
        if per_view:
            cloud = cloud._replace(
                colors=torch.rand(
                    3, 40, channels, generator=torch.Generator().manual_seed(0), dtype=torch.float64
                )
            )
        compare(
            backend,
            cloud,
            cameras(3, 14, 10),
            14,
            10,
            torch.rand(channels, generator=torch.Generator().manual_seed(1)),
        )

    def test_a_gaussian_with_one_bad_channel_is_in_no_group_of_channels(self, backend):
        cloud = random_cloud(30, seed=3, channels=5)
        cloud.colors[4, 4] = math.nan
        compare(backend, cloud, cameras(1, 14, 10), 14, 10)

    def test_absgrad_of_five_channels_is_exact(self, backend):
        compare(
            backend, random_cloud(30, seed=3, channels=5), cameras(1, 14, 10), 14, 10, absgrad=True
        )

    @repeatable
    @given(seed=st.integers(0, 10**6), n=st.integers(1, 60), antialias=st.booleans())
    def test_extreme_clouds(self, backend, seed, n, antialias):
        """Needles, discs, behind the camera, NaN, infinite, coincident, transparent, opaque:
        finite, and the image is correct.

        Some opacities are alpha_min itself, so whole images depend on one rounding; either outcome
        is correct.
        """
        cloud, camera = extreme_cloud(seed, n), cameras(2, 37, 13)
        ours = draw(backend, cloud, camera, 37, 13, antialias=antialias, camera_gradient=True)
        assert all(x.isfinite().all() for x in (*ours.out, *ours.grads.values()))
        options = {"antialias": antialias, "backend": "reference"}
        with torch.no_grad():
            truths = [
                rasterize(*cloud, *camera, 37, 13, alpha_min=x / 1024, **options).image
                for x in (1 - 1e-5, 1, 1 + 1e-5)
            ]
        distance = torch.stack([(ours.out.image - truth).abs() for truth in truths]).amin(0)
        # One alpha on the other side of alpha_min = 1/1024 moves a pixel by that times the range of
        # colours, 3.
        assert distance.max() < 3 / 1024 and (distance > 1e-4).float().mean() < 5e-3

    @repeatable
    @given(
        seed=st.integers(0, 10**6),
        n=st.integers(0, 80),
        size=st.floats(1e-3, 2.0),
        stretch=st.floats(0, 3),
        width=st.integers(1, 70),
        height=st.integers(1, 40),
    )
    def test_random_clouds(self, backend, seed, n, size, stretch, width, height):
        """Any size and shape. A few pixels may fall on the other side of a threshold, so the median
        error is tested.
        """
        cloud, camera = (
            random_cloud(n, seed, size=size, stretch=stretch),
            cameras(1 + seed % 3, width, height),
        )
        ours, truth = (
            draw(backend, cloud, camera, width, height),
            run(cloud, *camera, width, height, backend="reference"),
        )
        assert (ours.out.image - truth.out.image).abs().max() < 2 / 1024
        largest = max(
            (grad.abs().max() for grad in truth.grads.values() if grad.numel()), default=0
        )
        for name in NAMES:
            distance = (ours.grads[name] - truth.grads[name]).abs().flatten()
            assert n == 0 or distance.median() <= SINGLE * largest, name

    def test_needles_and_discs(self, backend):
        """Every combination of scales 1e-8 .. 1e4 and five rotations, one at a time: within 2e-5 of
        float64 (stability.md A1).
        """
        steps = torch.tensor([1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4], dtype=torch.float64)
        scales = torch.cartesian_prod(steps, steps, steps).repeat_interleave(5, 0)
        quats = (
            torch.randn(5, 4, generator=torch.Generator().manual_seed(2)).double().repeat(216, 1)
        )
        one = one_gaussian((0.1, -0.2, 2.0), 1.0, 0.8)
        camera, worst = front_camera(16, 16, 20.0), 0.0
        with torch.no_grad():
            for i in range(0, len(scales), 3):
                cloud = one._replace(scales=scales[i : i + 1], quats=quats[i : i + 1])
                single = [x.to(torch.float32) for x in (*cloud, *camera)]
                alphas = (
                    rasterize(*single, 16, 16, alpha_min=1e-5, backend=backend).alpha,
                    rasterize(*cloud, *camera, 16, 16, alpha_min=1e-5, backend="reference").alpha,
                )
                worst = max(worst, (alphas[0] - alphas[1]).abs().max().item())
        assert worst < 2e-5

    def test_gradient_of_a_needle(self, backend):
        """1000 : 1 at an angle. The determinant of its covariance cancels in float32 unless it is
        factored.
        """
        cloud = one_gaussian((0.02, -0.03, 2.0), (0.5, 5e-4, 5e-4), 0.7)._replace(
            quats=torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)
        )
        # 1e-3 is the bar of stability.md A1: a needle's edge moves by its length times any error of
        # the angle.
        compare(backend, cloud, front_camera(64, 64, 200.0), 64, 64, tolerance=1e-3, alpha_min=1e-5)

    @pytest.mark.parametrize("slope", [0.99, 1.29, 1.31, 5.0])
    def test_gradient_beyond_the_edge_of_the_image(self, backend, slope):
        """Inside and outside the clamp of the Jacobian, whose gradient keeps its z-term."""
        cloud = one_gaussian((2 * slope * 0.8, 0.1, 2.0), (1.5, 0.8, 0.4), 0.7)._replace(
            quats=torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)
        )
        compare(backend, cloud, front_camera(32, 32, 20.0), 32, 32, alpha_min=1e-6)

    def test_ten_thousand_gaussians_on_one_pixel(self, backend):
        camera = front_camera(3, 3, 4.0)
        for stack in stacks_on_one_pixel():
            truth, ours = (
                run(stack, *camera, 3, 3, backend="reference"),
                draw(backend, stack, camera, 3, 3),
            )
            assert error(ours.out.image, truth.out.image) < 1e-5
            for name in ("scales", "opacities", "colors", "means"):
                # Sums of up to ten thousand terms in float32; the bar of stability.md A1.
                assert trimmed_error(ours.grads[name], truth.grads[name]) < 1e-4, name

    def test_the_gaussian_that_crosses_the_stop_counts(self, backend):
        cloud = Cloud(*(x.repeat(4, *[1] * (x.dim() - 1)) for x in one_gaussian(scale=10.0)))
        cloud = cloud._replace(opacities=torch.tensor([0.9, 0.905, 0.99, 0.5], dtype=torch.float64))
        ours = draw(backend, cloud, front_camera(1, 1, 1.0), 1, 1)
        assert ours.out.alpha.item() == pytest.approx(1 - 0.1 * 0.095 * 0.01, abs=1e-6)
        assert ours.out.contribution[0, 3] == 0

    def test_equal_depths_are_drawn_by_index(self, backend):
        """64 Gaussians in one plane: the first is in front, for any permutation."""
        cloud = Cloud(
            *(x.repeat(64, *[1] * (x.dim() - 1)) for x in one_gaussian(scale=1.0, opacity=0.9))
        )
        colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        for seed in range(3):
            order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
            compare(backend, cloud._replace(colors=colors[order]), front_camera(8, 8, 4.0), 8, 8)

    def test_depth_order_is_exact(self, backend):
        """Depths one float apart, and over twenty orders of magnitude."""
        depths = torch.tensor([2.0], dtype=torch.float32).repeat(40)
        for i in range(1, 40):
            depths[i] = (
                torch.nextafter(depths[i - 1], torch.tensor(3.0)) if i < 20 else depths[i - 1] * 3
            )
        means = torch.stack([torch.zeros(40), torch.zeros(40), depths], 1).double()
        order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
        cloud = random_cloud(40, seed=1)._replace(
            means=means[order], scales=means[order][:, 2:].repeat(1, 3) * 0.2
        )
        truth, ours = (
            run(c, *(x.to(c.means.dtype) for x in front_camera(4, 4, 3.0)), 4, 4, backend=b)
            for c, b in ((cloud, "reference"), (cloud.to(torch.float32), backend))
        )
        assert (
            error(ours.out.image, truth.out.image) < 1e-5
            and error(ours.out.depth, truth.out.depth) < 1e-5
        )
