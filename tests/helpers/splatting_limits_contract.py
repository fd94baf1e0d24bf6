"""The contract of every kernel at its limits: extreme inputs, empty views, uses of autograd."""

import math

import pytest
import torch
from torch.utils.checkpoint import checkpoint

from tests.helpers.splatting_draws import BACKGROUND, compare, draw
from tests.helpers.splatting_scenes import (
    NAMES,
    Cloud,
    cameras,
    cotangents,
    equal,
    error,
    random_cloud,
    rasterize,
    require_backward_twice_adds_up,
)


class LimitsContract:
    """Subclass this with a fixture ``backend`` that returns the name of a backend."""

    @pytest.mark.parametrize(
        "attribute, value",
        [
            ("scales", math.inf),
            ("means", math.nan),
            ("colors", math.nan),
            ("quats", -math.inf),
            ("opacities", math.nan),
        ],
    )
    def test_a_gaussian_that_is_not_finite_changes_no_bit_of_the_others(
        self, backend, attribute, value
    ):
        cloud, camera = random_cloud(300, seed=6), cameras(2, 40, 24)
        corrupted = Cloud(*(x.clone() for x in cloud))
        getattr(corrupted, attribute)[7] = value
        rest = torch.arange(300) != 7
        with_it, without = (
            draw(backend, corrupted, camera, 40, 24),
            draw(backend, cloud.pick(rest), camera, 40, 24),
        )
        assert torch.equal(with_it.out.image, without.out.image) and torch.equal(
            with_it.out.contribution[:, rest], without.out.contribution
        )
        for name in NAMES:
            assert (
                torch.equal(with_it.grads[name][rest], without.grads[name])
                and (with_it.grads[name][7] == 0).all()
            )

    def test_quaternions_of_any_length(self, backend):
        cloud, camera = random_cloud(50, seed=7), cameras(1, 20, 20)
        once = draw(backend, cloud, camera, 20, 20)
        for factor in (-1.0, 5.0, 1e-8, 1e18):
            other = draw(backend, cloud._replace(quats=cloud.quats * factor), camera, 20, 20)
            assert error(other.out.image, once.out.image) < 1e-6
        none = draw(backend, cloud._replace(quats=torch.zeros(50, 4)), camera, 20, 20)
        identity = draw(
            backend,
            cloud._replace(quats=torch.tensor([1.0, 0, 0, 0]).repeat(50, 1)),
            camera,
            20,
            20,
        )
        assert torch.equal(none.out.image, identity.out.image) and (none.grads["quats"] == 0).all()

    @pytest.mark.parametrize("absgrad", [False, True])
    def test_nothing_to_see_is_the_background_bit_for_bit(self, backend, absgrad):
        for cloud in (
            random_cloud(0),
            random_cloud(5)._replace(means=torch.full((5, 3), 100.0).double()),
        ):
            for scale in (1, 2):
                result = draw(
                    backend,
                    cloud,
                    cameras(2, 10, 8),
                    10,
                    8,
                    BACKGROUND,
                    downsample=scale,
                    absgrad=absgrad,
                    camera_gradient=True,
                )
                assert (
                    torch.equal(result.out.image, BACKGROUND.expand(2, 8 // scale, 10 // scale, 3))
                    and (result.out.alpha == 0).all()
                )
                zeros = {name: result.grads[name] for name in (*NAMES, "viewmats", "means2d")}
                assert all((grad == 0).all() for grad in zeros.values())
                assert all(
                    zeros[name].shape == leaf.shape for name, leaf in zip(NAMES, cloud, strict=True)
                )
                assert (
                    error(result.grads["background"], cotangents(result.out)[0].sum((0, 1, 2)))
                    < 1e-6
                )

    def test_views_are_independent(self, backend):
        cloud, (viewmats, Ks) = random_cloud(400, seed=3), cameras(4, 40, 24)
        batch = draw(backend, cloud, (viewmats, Ks), 40, 24).out
        for view in range(4):
            alone = draw(
                backend, cloud, (viewmats[view : view + 1], Ks[view : view + 1]), 40, 24
            ).out
            assert all(
                torch.equal(ours[view], other[0]) for ours, other in zip(batch, alone, strict=True)
            )

    @pytest.mark.parametrize("channels", [2, 3])
    def test_gradients_may_come_in_any_layout(self, backend, channels):
        """As from a convolution: the operation after the render decides the memory layout of its
        gradient.
        """
        cloud, camera = (
            random_cloud(50, seed=14).to(torch.float32),
            [x.to(torch.float32) for x in cameras(2, 14, 12)],
        )
        cloud = cloud._replace(colors=cloud.colors[:, :channels])
        weights, grads = torch.randn(2, 12, 14, channels), []
        for layout in ((0, 1, 2, 3), (0, 2, 3, 1), (0, 3, 2, 1)):
            leaves = cloud.leaves()
            image = rasterize(*leaves, *camera, 14, 12, backend=backend).image
            (
                image.permute(layout).contiguous() * weights.permute(layout).contiguous()
            ).sum().backward()
            grads.append([leaf.grad for leaf in leaves])
        assert all(
            torch.equal(a, b) for others in grads[1:] for a, b in zip(grads[0], others, strict=True)
        )

    def test_what_is_not_read_of_a_camera_does_not_matter(self, backend):
        cloud, (viewmats, Ks) = random_cloud(30, seed=15), cameras(1, 12, 12)
        viewmats[:, 3] = Ks[:, 2] = Ks[:, 0, 1] = math.nan
        compare(backend, cloud, (viewmats, Ks), 12, 12)

    def test_several_forwards_before_their_backwards(self, backend):
        """Each graph owns what its backward pass needs, for any order of calls."""
        clouds = [random_cloud(n, seed=n).to(torch.float32) for n in (300, 40, 900)]
        camera = [x.to(torch.float32) for x in cameras(2, 70, 40)]
        alone = [draw(backend, cloud, camera, 70, 40) for cloud in clouds]
        leaves = [cloud.leaves() for cloud in clouds]
        outs = [rasterize(*cloud, *camera, 70, 40, backend=backend) for cloud in leaves]
        for i in (1, 2, 0):
            torch.autograd.backward(
                [outs[i].image, outs[i].alpha, outs[i].depth], cotangents(outs[i])
            )
        for cloud, expected in zip(leaves, alone, strict=True):
            assert all(
                torch.equal(leaf.grad, expected.grads[name])
                for name, leaf in zip(NAMES, cloud, strict=True)
            )

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
        camera = cameras(1, 40, 12, dtype=torch.float32)

        def gradients(run):
            cloud = random_cloud(30, seed=13).to(torch.float32).leaves()
            background = BACKGROUND.to(torch.float32).expand(1, 3).clone().requires_grad_()
            run(*cloud, background).square().sum().backward()
            return [leaf.grad for leaf in (*cloud, background)]

        def image(*tensors):
            cloud, background = tensors[:-1], tensors[-1]
            return rasterize(*cloud, *camera, 40, 12, background=background, backend=backend).image

        again = gradients(lambda *x: checkpoint(image, *x, use_reentrant=use_reentrant))
        assert all(torch.equal(a, b) for a, b in zip(again, gradients(image), strict=True))

    def test_backward_twice_adds_up(self, backend):
        cloud, camera = (
            random_cloud(30, seed=11).to(torch.float32).leaves(),
            [x.to(torch.float32) for x in cameras(1, 12, 12)],
        )
        require_backward_twice_adds_up(cloud, camera, backend, exact=True)

    def test_absgrad_is_zero_without_a_gradient(self, backend):
        """A loss may ignore a render."""
        cloud, camera = (
            random_cloud(5).to(torch.float32).leaves(),
            cameras(2, 12, 12, dtype=torch.float32),
        )
        assert torch.equal(
            rasterize(*cloud, *camera, 12, 12, backend=backend, absgrad=True).means2d.absgrad,
            torch.zeros(2, 5, 2),
        )

    @pytest.mark.parametrize("names", [("image",), ("alpha",), ("depth",), ("image", "depth")])
    def test_pictures_without_a_gradient_count_as_zero(self, backend, names):
        cloud, camera = (
            random_cloud(50, seed=12).to(torch.float32),
            [x.to(torch.float32) for x in cameras(1, 40, 12)],
        )
        sparse, full = cloud.leaves(), cloud.leaves()
        out = rasterize(*sparse, *camera, 40, 12, backend=backend)
        sum(getattr(out, name).square().sum() for name in names).backward()
        out = rasterize(*full, *camera, 40, 12, backend=backend)
        sum(
            getattr(out, name).square().sum() * (name in names)
            for name in ("image", "alpha", "depth")
        ).backward()
        assert all(
            torch.equal(a.grad, b.grad)
            for a, b in zip(sparse, full, strict=True)
            if a.grad is not None
        )
