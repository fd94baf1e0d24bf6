"""The contract of every kernel, a class to subclass: as the specification in float64 draws."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.utils.checkpoint import checkpoint

from tests.helpers.splatting_scenes import (
    BACKGROUND,
    NAMES,
    NO_CUTOFFS,
    SINGLE,
    cameras,
    compare,
    cotangents,
    draw,
    equal,
    error,
    extreme_cloud,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
    repeatable,
    specified,
    trimmed_error,
)

TWO_BACKGROUNDS = torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])
OPTIONS = [
    {"preset": "fast"}, {"preset": "accurate", "antialias": True}, {"stop": 0.2}, NO_CUTOFFS,
    {"absgrad": True, "downsample": 2}, {"absgrad": True, "antialias": True, "eps2d": 0.1},
    {"alpha_max": 0.6, "absgrad": True}, {"near": 2.9, "far": 3.2, "background": TWO_BACKGROUNDS},
]  # fmt: skip
each_options = pytest.mark.parametrize("options", OPTIONS, ids=str)
TILTED = torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)


def single(*size: int, views: int = 1) -> tuple:
    """Return cameras in float32, and the size."""
    return *cameras(views, *size, dtype=torch.float32), *size


class KernelContract:
    """Subclass this with a fixture ``backend`` that returns the name of a backend."""

    @pytest.mark.parametrize("size", [(1, 1), (1, 7), (17, 33), (31, 16), (67, 2)])
    def test_sizes_that_are_no_multiple_of_a_tile(self, backend, size):
        compare(backend, random_cloud(60, seed=size[0]), cameras(2, *size), *size, BACKGROUND)

    @each_options
    def test_options(self, backend, options):
        compare(backend, random_cloud(150, seed=1, size=0.2), cameras(2, 34, 18), 34, 18, **options)

    @pytest.mark.parametrize("downsample", [1, 2])
    def test_the_backgrounds_gradient_where_there_is_nothing_else(self, backend, downsample):
        """Most tiles have no Gaussian; a loss of alpha alone doesn't depend on the background."""
        cloud = random_cloud(3, seed=2, size=0.02).to(torch.float32).leaves()
        background = torch.tensor(BACKGROUND.tolist(), requires_grad=True)
        options = {"background": background, "backend": backend, "downsample": downsample}
        view = single(150 * downsample, 90 * downsample, views=2)
        out = rasterize(*cloud, *view, **options)
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

    def test_more_than_a_chunk_of_gaussians_over_whole_tiles(self, backend):
        """Faint ones, so that none is hidden; the CPU kernel keeps no lists of so many pairs."""
        cloud = random_cloud(600, seed=6, size=0.6)
        cloud.opacities.mul_(0.02)
        compare(backend, cloud, cameras(2, 34, 18), 34, 18, BACKGROUND, preset="accurate")

    def test_thousands_of_gaussians_on_hundreds_of_tiles(self, backend):
        """Against torch in float64, many times faster than the specification."""
        cloud, camera = random_cloud(8000, seed=5, size=0.02), cameras(2, 160, 144)
        truth = specified(cloud, *camera, 160, 144, BACKGROUND, backend="torch")
        ours = draw(backend, cloud, camera, 160, 144, BACKGROUND)
        for name in ("image", "alpha", "depth"):
            pictures = (getattr(drawn.out, name).flatten(0, 2) for drawn in (ours, truth))
            assert trimmed_error(*pictures) < 2e-6, name
        for name in NAMES:
            assert trimmed_error(ours.grads[name], truth.grads[name]) < SINGLE, name

    @pytest.mark.parametrize("channels", [1, 2, 5])
    @pytest.mark.parametrize("per_view", [False, True])
    def test_channels_shared_or_per_view(self, backend, channels, per_view):
        g = torch.Generator().manual_seed(0)
        cloud, background = random_cloud(40, seed=2, channels=channels), torch.rand(channels)
        if per_view:
            colors = torch.rand(3, 40, channels, generator=g, dtype=torch.float64)
            cloud = cloud._replace(colors=colors)
        compare(backend, cloud, cameras(3, 14, 10), 14, 10, background)

    def test_absgrad_of_five_channels_of_which_one_is_bad(self, backend):
        cloud = random_cloud(30, seed=3, channels=5)
        compare(backend, cloud, cameras(1, 14, 10), 14, 10, absgrad=True)
        cloud.colors[4, 4] = math.nan
        compare(backend, cloud, cameras(1, 14, 10), 14, 10)

    @repeatable
    @given(seed=st.integers(0, 10**6), n=st.integers(1, 60), antialias=st.booleans())
    def test_extreme_clouds(self, backend, seed, n, antialias):
        """Either outcome is right for an alpha at alpha_min; it moves a pixel by 3/1024."""
        cloud, view = extreme_cloud(seed, n), (cameras(2, 37, 13), 37, 13)
        ours = draw(backend, cloud, *view, antialias=antialias, camera_gradient=True)
        assert all(x.isfinite().all() for x in (*ours.out, *ours.grads.values()))
        options = {"antialias": antialias, "backend": "reference"}
        with torch.no_grad():
            truths = [
                rasterize(*cloud, *view[0], 37, 13, alpha_min=x / 1024, **options).image
                for x in (1 - 1e-5, 1, 1 + 1e-5)
            ]
        distance = torch.stack([(ours.out.image - truth).abs() for truth in truths]).amin(0)
        assert distance.max() < 3 / 1024 and (distance > 1e-4).float().mean() < 5e-3

    @repeatable
    @given(
        seed=st.integers(0, 10**6), n=st.integers(0, 80), size=st.floats(1e-3, 2.0),
        stretch=st.floats(0, 3), width=st.integers(1, 70), height=st.integers(1, 40),
    )  # fmt: skip
    def test_random_clouds(self, backend, seed, n, size, stretch, width, height):
        """Any size and shape; the median, since a few pixels may fall beyond a threshold."""
        cloud = random_cloud(n, seed, size=size, stretch=stretch)
        camera = cameras(1 + seed % 3, width, height)
        ours = draw(backend, cloud, camera, width, height)
        truth = specified(cloud, *camera, width, height)
        assert (ours.out.image - truth.out.image).abs().max() < 2 / 1024
        largest = max((g.abs().max() for g in truth.grads.values() if g.numel()), default=0)
        for name in NAMES:
            distance = (ours.grads[name] - truth.grads[name]).abs().flatten()
            assert n == 0 or distance.median() <= SINGLE * largest, name

    def test_gradient_of_a_needle(self, backend):
        """1000 : 1 at an angle: the determinant cancels in float32 unless it is factored."""
        cloud = one_gaussian((0.02, -0.03, 2.0), (0.5, 5e-4, 5e-4), 0.7)._replace(quats=TILTED)
        compare(backend, cloud, front_camera(64, 64, 200.0), 64, 64, tolerance=1e-3, alpha_min=1e-5)

    @pytest.mark.parametrize("absgrad", [False, True])
    @pytest.mark.parametrize("scale", [1, 2])
    def test_nothing_to_see_is_the_background_bit_for_bit(self, backend, absgrad, scale):
        away = random_cloud(5)._replace(means=torch.full((5, 3), 100.0).double())
        options = {"downsample": scale, "absgrad": absgrad, "camera_gradient": True}
        for cloud in (random_cloud(0), away):
            out, grads = draw(backend, cloud, cameras(2, 10, 8), 10, 8, BACKGROUND, **options)
            expected = BACKGROUND.expand(2, 8 // scale, 10 // scale, 3)
            assert torch.equal(out.image, expected) and (out.alpha == 0).all()
            assert all((grads[name] == 0).all() for name in (*NAMES, "viewmats", "means2d"))
            for name, leaf in zip(NAMES, cloud, strict=True):
                assert grads[name].shape == leaf.shape
            assert error(grads["background"], cotangents(out)[0].sum((0, 1, 2))) < 1e-6

    def test_views_are_independent(self, backend):
        cloud, (viewmats, Ks) = random_cloud(400, seed=3), cameras(4, 40, 24)
        batch = draw(backend, cloud, (viewmats, Ks), 40, 24).out
        for view in range(4):
            camera = viewmats[view : view + 1], Ks[view : view + 1]
            alone = draw(backend, cloud, camera, 40, 24).out
            for ours, other in zip(batch, alone, strict=True):
                assert torch.equal(ours[view], other[0])

    @pytest.mark.parametrize("channels", [2, 3])
    def test_gradients_may_come_in_any_layout(self, backend, channels):
        """The operation after the render decides the memory layout of its gradient."""
        cloud, view = random_cloud(50, seed=14).to(torch.float32), single(14, 12, views=2)
        cloud = cloud._replace(colors=cloud.colors[:, :channels])
        weights, grads = torch.randn(2, 12, 14, channels), []
        for layout in ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 2, 1)):
            leaves = cloud.leaves()
            image = rasterize(*leaves, *view, backend=backend).image
            product = image.permute(layout).contiguous() * weights.permute(layout).contiguous()
            product.sum().backward()
            grads.append([leaf.grad for leaf in leaves])
        for others in grads[1:]:
            assert all(torch.equal(a, b) for a, b in zip(grads[0], others, strict=True))

    def test_what_is_not_read_of_a_camera_does_not_matter(self, backend):
        cloud, (viewmats, Ks) = random_cloud(30, seed=15), cameras(1, 12, 12)
        viewmats[:, 3] = Ks[:, 2] = Ks[:, 0, 1] = math.nan
        compare(backend, cloud, (viewmats, Ks), 12, 12)

    def test_several_forwards_before_their_backwards(self, backend):
        """Each graph owns what its backward pass needs, for any order of calls."""
        clouds, view = [random_cloud(n, seed=n) for n in (300, 40, 900)], single(70, 40, views=2)
        alone = [draw(backend, cloud, view[:2], 70, 40) for cloud in clouds]
        leaves = [cloud.to(torch.float32).leaves() for cloud in clouds]
        outs = [rasterize(*cloud, *view, backend=backend) for cloud in leaves]
        for out in (outs[1], outs[2], outs[0]):
            torch.autograd.backward([out.image, out.alpha, out.depth], cotangents(out))
        for cloud, expected in zip(leaves, alone, strict=True):
            for name, leaf in zip(NAMES, cloud, strict=True):
                assert torch.equal(leaf.grad, expected.grads[name])

    def test_hooks_on_saved_tensors_may_replace_them(self, backend):
        """As checkpointing and offloading do: what the kernel kept is recomputed."""
        cloud, camera = random_cloud(30, seed=13), cameras(1, 40, 12)
        plain = draw(backend, cloud, camera, 40, 12)
        with torch.autograd.graph.saved_tensors_hooks(torch.clone, lambda x: x):
            hooked = draw(backend, cloud, camera, 40, 12)
        assert equal(plain, hooked)

    @pytest.mark.parametrize("use_reentrant", [False, True])
    def test_checkpointing(self, backend, use_reentrant):
        """Without reentrance, each saved tensor may be read once."""

        def gradients(run):
            cloud = random_cloud(30, seed=13).to(torch.float32).leaves()
            background = BACKGROUND.to(torch.float32).expand(1, 3).clone().requires_grad_()
            run(*cloud, background).square().sum().backward()
            return [leaf.grad for leaf in (*cloud, background)]

        def image(*tensors):
            options = {"background": tensors[-1], "backend": backend}
            return rasterize(*tensors[:-1], *single(40, 12), **options).image

        again = gradients(lambda *x: checkpoint(image, *x, use_reentrant=use_reentrant))
        assert all(torch.equal(a, b) for a, b in zip(again, gradients(image), strict=True))

    def test_backward_twice_adds_up(self, backend):
        cloud = random_cloud(30, seed=11).to(torch.float32).leaves()
        out = rasterize(*cloud, *single(12, 12), backend=backend, absgrad=True)
        images, gradients = [out.image, out.alpha, out.depth], cotangents(out)
        torch.autograd.backward(images, gradients, retain_graph=True)
        once = [x.clone() for x in (cloud.means.grad, out.means2d.grad, out.means2d.absgrad)]
        torch.autograd.backward(images, gradients)
        twice = cloud.means.grad, out.means2d.grad, out.means2d.absgrad
        assert all(torch.equal(2 * first, both) for first, both in zip(once, twice, strict=True))

    def test_absgrad_is_zero_without_a_gradient(self, backend):
        """A loss may ignore a render."""
        cloud = random_cloud(5).to(torch.float32).leaves()
        out = rasterize(*cloud, *single(12, 12, views=2), backend=backend, absgrad=True)
        assert torch.equal(out.means2d.absgrad, torch.zeros(2, 5, 2))

    @pytest.mark.parametrize("names", [("image",), ("alpha",), ("depth",), ("image", "depth")])
    def test_pictures_without_a_gradient_count_as_zero(self, backend, names):
        cloud = random_cloud(50, seed=12).to(torch.float32)
        sparse, full = cloud.leaves(), cloud.leaves()
        for leaves, parts in ((sparse, names), (full, ("image", "alpha", "depth"))):
            out = rasterize(*leaves, *single(40, 12), backend=backend)
            losses = (getattr(out, part).square().sum() * (part in names) for part in parts)
            sum(losses).backward()
        for a, b in zip(sparse, full, strict=True):
            assert a.grad is None or torch.equal(a.grad, b.grad)
