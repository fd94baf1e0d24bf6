"""Non-finite and degenerate inputs of the specification, and an independent implementation."""

import math
import sys

import pytest
import torch

from benchmarks.splatting import gsplat_reference
from tests.helpers import splatting_scenes as scenes
from tests.splatting.reference_cases import ROUNDING, SPECIFICATION
from threestudio_gaussiandreamer.splatting.projection import quats_to_rotations

# ---- what can't be drawn -------------------------------------------------------------------------


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize("name", scenes.NAMES)
def test_a_non_finite_gaussian_equals_a_transparent_one(name, value):
    """Pixels and gradients have the same bits as with a transparent Gaussian instead; its own
    gradients are zeros, not NaN.
    """
    cloud, camera = scenes.random_cloud(15, seed=12), scenes.cameras(2, 8, 6)
    transparent = scenes.Cloud(*(x.clone() for x in cloud))
    transparent.opacities[4] = 0
    getattr(cloud, name)[4, ...] = value
    with_it, without = (
        scenes.run(c, *camera, 8, 6, camera_gradient=True, **SPECIFICATION)
        for c in (cloud, transparent)
    )
    assert (
        torch.equal(with_it.out.image, without.out.image) and (with_it.out.radii[:, 4] == 0).all()
    )
    for attribute, grad in with_it.grads.items():
        assert torch.equal(grad, without.grads[attribute]), attribute
    assert all((with_it.grads[attribute][4] == 0).all() for attribute in scenes.NAMES)


@pytest.mark.parametrize(
    "offset, drawn", [(-0.1, False), (-1e-7, False), (0.0, False), (1e-7, True), (0.1, True)]
)
def test_near_plane(offset, drawn):
    out = scenes.run(
        scenes.one_gaussian((0.0, 0.0, 0.5 + offset), 0.01),
        *scenes.front_camera(8, 8, 4.0),
        8,
        8,
        near=0.5,
        **SPECIFICATION,
    )
    assert (out.out.radii.item() > 0) == drawn and (out.out.alpha.max() > 0) == drawn
    assert all(g.isfinite().all() and (drawn or (g == 0).all()) for g in out.grads.values())


@pytest.mark.parametrize(
    "mean", [(0.0, 0.0, 0.0), (0.0, 0.0, -1.0), (1.0, 1.0, 0.0), (0.0, 0.0, 1e38), (1e38, 0.0, 1.0)]
)
def test_at_or_behind_the_camera_or_absurdly_far(mean):
    cloud = scenes.Cloud(
        *(
            torch.cat(pair)
            for pair in zip(scenes.one_gaussian(mean), scenes.one_gaussian(), strict=True)
        )
    ).to(torch.float32)
    camera = scenes.front_camera(6, 6, 5.0)
    with_it, alone = (
        scenes.run(cloud, *camera, 6, 6, far=1e30, **SPECIFICATION),
        scenes.run(cloud.pick([1]), *camera, 6, 6, far=1e30, **SPECIFICATION),
    )
    assert torch.equal(with_it.out.image, alone.out.image) and with_it.out.radii[0, 0] == 0
    assert all((with_it.grads[name][0] == 0).all() for name in scenes.NAMES)


def test_a_non_finite_camera_affects_its_own_view_only():
    cloud, (viewmats, Ks) = scenes.random_cloud(10, seed=13), scenes.cameras(2, 6, 5)
    background = torch.tensor([0.3, 0.5, 0.7], dtype=torch.float64)
    broken = viewmats.clone()
    broken[0, 1, 2] = math.nan
    bad, good = (
        scenes.run(cloud, broken, Ks, 6, 5, background, **SPECIFICATION),
        scenes.run(cloud, viewmats, Ks, 6, 5, background, **SPECIFICATION),
    )
    assert torch.equal(bad.out.image[1], good.out.image[1])
    assert torch.equal(bad.out.image[0], background.expand(5, 6, 3))
    assert all(g.isfinite().all() for g in bad.grads.values())


@pytest.mark.parametrize("backend", ["reference", "torch"])
@pytest.mark.parametrize("place", [(0, 0), (0, 2)])
def test_a_camera_that_overflows_affects_its_own_view_only(place, backend):
    cloud, (viewmats, Ks) = (
        scenes.random_cloud(10, seed=13).to(torch.float32),
        scenes.cameras(2, 6, 5, dtype=torch.float32),
    )
    elsewhere, absurd = Ks.clone(), Ks.clone()
    elsewhere[0, 0, 2], absurd[0][place] = 1e6, 1e30
    good, bad = (
        scenes.run(cloud, viewmats, K, 6, 5, antialias=True, backend=backend)
        for K in (elsewhere, absurd)
    )
    assert torch.equal(bad.out.image, good.out.image)
    assert all(torch.equal(bad.grads[name], good.grads[name]) for name in scenes.NAMES)


@pytest.mark.parametrize(
    "cloud",
    [
        scenes.random_cloud(0),
        scenes.random_cloud(5)._replace(means=torch.full((5, 3), 100.0, dtype=torch.float64)),
    ],
)
def test_nothing_to_see_is_the_background_with_zero_gradients(cloud):
    background = torch.tensor([0.1, 0.2, 0.3], dtype=torch.float64)
    result = scenes.run(cloud, *scenes.cameras(2, 6, 4), 6, 4, background, **SPECIFICATION)
    assert torch.equal(result.out.image, background.expand(2, 4, 6, 3))
    assert (result.out.alpha == 0).all() and (result.out.depth == 0).all()
    for name, leaf in zip(scenes.NAMES, cloud, strict=True):
        assert result.grads[name].shape == leaf.shape and (result.grads[name] == 0).all()
    assert result.grads["means2d"].shape == (2, len(cloud.means), 2)


@pytest.mark.parametrize(
    "quat", [(0.0, 0, 0, 0), (1e-20, 0, 0, 1e-20), (0, 1e-38, 0, 0), (1e-42, 0, 1e-42, 0)]
)
def test_a_quaternion_without_length_is_no_rotation_without_gradient(quat):
    quats = torch.tensor([quat], dtype=torch.float32, requires_grad=True)
    rotation = quats_to_rotations(quats)
    rotation.sum().backward()
    assert torch.equal(rotation[0], torch.eye(3)) and torch.equal(quats.grad, torch.zeros(1, 4))


@pytest.mark.parametrize("factor", [-1.0, 5.0, 1e20, 1e-10])
def test_the_length_of_a_quaternion_does_not_matter(factor):
    quats = torch.randn(20, 4, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(quats_to_rotations(quats * factor), quats_to_rotations(quats), atol=5e-7)


def test_float32_keeps_every_needle_and_disc_that_float64_keeps():
    """The determinant is a sum of squares, so it neither cancels nor overflows: no Gaussian is lost
    (stability.md A1).
    """
    steps = torch.tensor([1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4], dtype=torch.float64)
    scales = torch.cartesian_prod(steps, steps, steps).repeat(3, 1)
    g = torch.Generator().manual_seed(1)
    quats = (
        torch.randn(3, 4, generator=g, dtype=torch.float64)
        .float()
        .double()
        .repeat_interleave(len(scales) // 3, 0)
    )
    means = torch.tensor([0.1, -0.2, 2.0], dtype=torch.float64).expand(len(scales), 3)
    cloud = scenes.Cloud(
        means,
        quats,
        scales,
        torch.full((len(scales),), 0.8).double(),
        torch.ones(len(scales), 1).double(),
    )
    options = SPECIFICATION | {"stop": 0.0, "alpha_min": 1e-5}
    wide, narrow = (
        scenes.run(cloud.to(dtype), *scenes.front_camera(16, 16, 20.0), 16, 16, **options)
        for dtype in (torch.float64, torch.float32)
    )
    assert torch.equal(wide.out.radii > 0, narrow.out.radii > 0) and (wide.out.radii > 0).all()
    assert all(g.isfinite().all() for g in narrow.grads.values())


# ---- an implementation that we did not write -----------------------------------------------------


@pytest.fixture
def gsplat(monkeypatch):
    """Import gsplat's plain-torch functions; the two CUDA-only functions of nerfacc that they call
    are replaced by plain torch.
    """
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl", reason="pip install gsplat")

    monkeypatch.setitem(sys.modules, "nerfacc", gsplat_reference.nerfacc())
    return torch_impl


@pytest.mark.parametrize("antialias", [False, True])
def test_gsplat_draws_the_same_and_has_the_same_gradients(gsplat, antialias):
    """With its cap .999 and threshold 1/255 (our preset fast). Its early termination is exclusive,
    ours is not, so it is off here.
    """
    width, height, views = 10, 8, 2
    cloud = scenes.random_cloud(25, seed=14, size=0.25)
    viewmats, Ks = scenes.cameras(views, width, height)
    cloud.opacities[:3] = 0.9999  # reaches the cap
    options = {"preset": "fast", "alpha_max": 0.999, "stop": 0.0, "antialias": antialias}
    ours = scenes.run(cloud, viewmats, Ks, width, height, **options, **SPECIFICATION)

    leaves = cloud.leaves()
    covariances, _ = gsplat._quat_scale_to_covar_preci(leaves.quats, leaves.scales, True, False)
    _, means2d, depths, conics, compensation = gsplat._fully_fused_projection(
        leaves.means, covariances, viewmats, Ks, width, height, calc_compensations=antialias
    )
    opacities = leaves.opacities.expand(views, -1) * (compensation if antialias else 1)
    features = torch.cat([leaves.colors.expand(views, -1, -1), depths[..., None]], -1)
    ids = pairs_of_gsplat(
        means2d.detach(), conics.detach(), opacities.detach(), depths.detach(), width, height
    )
    image, alpha = gsplat.accumulate(means2d, conics, opacities, features, *ids, width, height)
    assert scenes.error(ours.out.means2d, means2d) < ROUNDING
    assert (
        scenes.error(ours.out.image, image[..., :3]) < ROUNDING
        and scenes.error(ours.out.depth, image[..., 3:]) < ROUNDING
    )
    assert scenes.error(ours.out.alpha, alpha) < ROUNDING
    torch.autograd.backward(
        [image[..., :3], alpha, image[..., 3:]], list(scenes.cotangents(ours.out))
    )
    for name, leaf in zip(scenes.NAMES, leaves, strict=True):
        assert scenes.error(ours.grads[name], leaf.grad) < ROUNDING, name


def pairs_of_gsplat(means2d, conics, opacities, depths, width, height):
    """Return (Gaussian, pixel, image) of every alpha >= 1/255, by image, pixel, depth, as its CUDA
    helper would.
    """
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    d = torch.stack([x, y], -1).reshape(1, -1, 1, 2) - means2d[:, None]
    a, b, c = conics[:, None].unbind(-1)
    alphas = opacities[:, None] * torch.exp(
        -0.5 * (a * d[..., 0] ** 2 + c * d[..., 1] ** 2) - b * d[..., 0] * d[..., 1]
    )
    order = depths.argsort(-1)
    image, pixel, place = (
        (torch.gather(alphas, 2, order[:, None].expand_as(alphas)) >= 1 / 255).nonzero().unbind(1)
    )
    return order[image, place], pixel, image
