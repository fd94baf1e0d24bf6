"""The specification against closed forms, loops, finite differences, and another implementation."""

import math
import sys

import numpy as np
import pytest
import torch

from benchmarks.splatting import gsplat_reference
from tests.helpers import splatting_scenes as scenes
from threestudio_gaussiandreamer.splatting import RasterizeOptions, projection, reference

SPECIFICATION = {"backend": "reference"}
ROUNDING = 1e-10  # float64 against the same formula in another order
TRUTH = SPECIFICATION | scenes.NO_CUTOFFS


def draw(cloud, camera, width, height, **options):
    return scenes.rasterize(*cloud, *camera, width, height, **{**SPECIFICATION, **options})


@pytest.mark.parametrize("side", [-1, 1])
@pytest.mark.parametrize("beyond", [0.8, 1.2])
def test_the_jacobian_is_clamped_30_percent_beyond_the_image(side, beyond):
    """Aligned with the axes, the variance is ``(f/z)^2 (sx^2 + slope^2 sz^2) + eps2d``."""
    width, focal, z, centre = 20, 10.0, 2.0, 7.0
    limit = ((width - centre) / focal if side > 0 else centre / focal) + 0.3 * 0.5 * width / focal
    Ks = torch.tensor([[[focal, 0, centre], [0, focal, 5.0], [0, 0, 1]]], dtype=torch.float64)
    cloud = scenes.one_gaussian((side * beyond * limit * z, 0.0, z), (0.1, 0.2, 3.0))
    viewmats = torch.eye(4, dtype=torch.float64)[None]
    scene = scenes.scene_of(cloud, viewmats, Ks, width, 10)
    splats = projection.project(scene, RasterizeOptions(**scenes.NO_CUTOFFS))
    variance_x = (focal / z) ** 2 * (0.1**2 + (min(beyond, 1) * limit) ** 2 * 3.0**2) + 0.3
    variance_y = (focal / z) ** 2 * 0.2**2 + 0.3
    conic, x = [1 / variance_x, 0, 1 / variance_y], centre + side * beyond * limit * focal
    assert splats.conics[0, 0].tolist() == pytest.approx(conic, rel=1e-12)
    assert splats.means2d[0, 0, 0].item() == pytest.approx(x, rel=1e-12)


def by_hand(cloud: scenes.Cloud, viewmat, K, width, height, alpha_min, alpha_max, stop, eps2d=0.3):
    """Loop over pixels and Gaussians, with Rodrigues' rotations and numpy's inverse."""
    means, quats, scales, opacities, colors = (x.numpy() for x in cloud)
    viewmat, K, splats = viewmat.numpy(), K.numpy(), []
    for i in range(len(means)):
        x, y, z = t = viewmat[:3, :3] @ means[i] + viewmat[:3, 3]
        w, axis = quats[i, 0], quats[i, 1:]
        angle, length = 2 * math.atan2(np.linalg.norm(axis), w), np.linalg.norm(axis)
        a, b, c = axis / length
        k = np.array([[0, -c, b], [c, 0, -a], [-b, a, 0]])
        rotation = np.eye(3) + math.sin(angle) * k + (1 - math.cos(angle)) * k @ k
        axes = viewmat[:3, :3] @ rotation @ np.diag(scales[i])
        sigma = axes @ axes.T
        J = np.array([[K[0, 0] / z, 0, -K[0, 0] * x / z**2], [0, K[1, 1] / z, -K[1, 1] * y / z**2]])
        splats.append((z, i, (K @ t)[:2] / z, np.linalg.inv(J @ sigma @ J.T + eps2d * np.eye(2))))
    image, largest = np.zeros((height, width, 5)), np.zeros(len(means))
    for v, u in np.ndindex(height, width):
        T = 1.0
        for z, i, mean, conic in sorted(splats, key=lambda s: s[:2]):
            d = np.array([u + 0.5, v + 0.5]) - mean
            alpha = min(alpha_max, opacities[i] * math.exp(-0.5 * d @ conic @ d))
            if alpha < alpha_min:
                continue
            image[v, u] += np.array([*colors[i], z, 1.0]) * alpha * T
            largest[i] = max(largest[i], alpha * T)
            T *= 1 - alpha
            if T < stop:
                break
    return image, largest


@pytest.mark.parametrize(
    "cutoffs", [scenes.NO_CUTOFFS, {"alpha_min": 0.02, "alpha_max": 0.7, "stop": 0.05}]
)
def test_a_cloud_equals_loops_written_by_hand(cutoffs):
    cloud, (viewmats, Ks) = scenes.random_cloud(12, seed=3, size=0.3), scenes.cameras(1, 9, 7)
    out = draw(cloud, (viewmats, Ks), 9, 7, **cutoffs)
    image, largest = by_hand(cloud, viewmats[0], Ks[0], 9, 7, **cutoffs)
    found = torch.cat([out.image, out.depth, out.alpha], -1)[0]
    np.testing.assert_allclose(found, image, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(out.contribution[0], largest, rtol=1e-9, atol=1e-12)


def test_downsampling_is_the_mean_of_boxes_and_radii_bound_what_is_drawn():
    cloud, camera = scenes.random_cloud(50, seed=7), scenes.cameras(2, 12, 10)
    background = torch.tensor([0.2, 0.4, 0.8], dtype=torch.float64)
    full, half = (draw(cloud, camera, 12, 10, background=background, downsample=d) for d in (1, 2))
    for name in ("image", "alpha", "depth"):
        boxes = getattr(full, name).reshape(2, 5, 2, 6, 2, -1).mean((2, 4))
        assert torch.allclose(getattr(half, name), boxes, atol=1e-14), name
    assert torch.equal(half.means2d, full.means2d)
    assert torch.equal(half.contribution, full.contribution)
    cloud = scenes.one_gaussian((0.1, -0.05, 2.0), (0.3, 0.1, 0.1), 0.9)
    out = draw(cloud, scenes.front_camera(64, 64, 40.0), 64, 64, alpha_min=1 / 255)
    places = out.alpha[0, ..., 0].nonzero().flip(1) + 0.5
    reach = (places - out.means2d[0, 0]).abs().max().item()
    assert reach <= out.radii.item() <= reach + 1


def test_means2d_gradient_is_per_view_in_pixels_and_absgrad_adds_up_absolute_values():
    """Shifting the principal point of a view shifts its means2d and nothing else."""
    cloud = scenes.random_cloud(20, seed=9, size=0.1)
    viewmats, Ks = scenes.cameras(2, 12, 10, distance=6.0)
    grads = scenes.run(cloud, viewmats, Ks, 12, 10, downsample=2, **TRUTH).grads["means2d"]

    def loss(Ks):
        out = scenes.rasterize(*cloud, viewmats, Ks, 12, 10, downsample=2, **TRUTH)
        pairs = zip((out.image, out.alpha, out.depth), scenes.cotangents(out), strict=True)
        return sum((x * g).sum() for x, g in pairs)

    for view in range(2):
        for axis in range(2):
            step = torch.zeros_like(Ks)
            step[view, axis, 2] = 1e-5
            slope = (loss(Ks + step) - loss(Ks - step)).item() / 2e-5
            # Central differences of a loss of order 10 with this step are good to 1e-8.
            found = grads[view, :, axis].sum().item()
            assert found == pytest.approx(slope, rel=1e-5, abs=1e-7)
    cloud, camera = scenes.random_cloud(6, seed=10, size=0.3), scenes.cameras(2, 4, 3)
    leaves = cloud.leaves()
    out = scenes.rasterize(*leaves, *camera, 4, 3, absgrad=True, **SPECIFICATION)
    g = scenes.cotangents(out)[0]
    expected = torch.zeros_like(out.means2d)
    for pixel in np.ndindex(*out.image.shape[:3]):
        alone = torch.zeros_like(g)
        alone[pixel] = g[pixel]
        fresh = scenes.rasterize(*leaves, *camera, 4, 3, **SPECIFICATION)
        fresh.image.backward(alone)
        expected += fresh.means2d.grad.abs()
    out.image.backward(g)
    assert torch.allclose(out.means2d.absgrad, expected, atol=1e-14)
    assert (out.means2d.absgrad > out.means2d.grad.abs()).any()


def test_chunks_of_pixels_change_nothing(monkeypatch):
    cloud, camera = scenes.random_cloud(30, seed=11), scenes.cameras(2, 7, 6)
    options = {"absgrad": True, "background": torch.rand(3, dtype=torch.float64)}
    whole = scenes.run(cloud, *camera, 7, 6, camera_gradient=True, **options, **SPECIFICATION)
    monkeypatch.setattr(reference, "CHUNK_BYTES", 40_000)
    parts = scenes.run(cloud, *camera, 7, 6, camera_gradient=True, **options, **SPECIFICATION)
    assert scenes.error(parts.out.image, whole.out.image) < ROUNDING
    assert scenes.error(parts.out.means2d.absgrad, whole.out.means2d.absgrad) < ROUNDING
    for name, grad in whole.grads.items():
        assert scenes.error(parts.grads[name], grad) < ROUNDING, name


@pytest.mark.parametrize("backend", ["reference", "torch"])
@pytest.mark.parametrize("name, place, value", [("view", (1, 2), math.nan), ("K", (0, 0), 1e30)])
def test_a_camera_that_overflows_affects_its_own_view_only(backend, name, place, value):
    cloud = scenes.random_cloud(10, seed=13).to(torch.float32)
    viewmats, Ks = scenes.cameras(2, 6, 5, dtype=torch.float32)
    (elsewhere := Ks.clone())[0, 0, 2] = 1e6
    absurd = {"view": viewmats.clone(), "K": Ks.clone()}
    absurd[name][0][place] = value
    views = (viewmats, elsewhere), (absurd["view"], absurd["K"])
    good, bad = (scenes.run(cloud, *view, 6, 5, antialias=True, backend=backend) for view in views)
    assert torch.equal(bad.out.image, good.out.image)
    assert all(torch.equal(bad.grads[name], good.grads[name]) for name in scenes.NAMES)


@pytest.fixture
def gsplat(monkeypatch):
    """Import gsplat's plain-torch functions, with plain torch in place of nerfacc."""
    torch_impl = pytest.importorskip("gsplat.cuda._torch_impl", reason="pip install gsplat")

    monkeypatch.setitem(sys.modules, "nerfacc", gsplat_reference.nerfacc())
    return torch_impl


@pytest.mark.parametrize("antialias", [False, True])
def test_gsplat_draws_the_same_and_has_the_same_gradients(gsplat, antialias):
    """With its cap and threshold; without early termination, which is exclusive there."""
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
    drawn = (x.detach() for x in (means2d, conics, opacities, depths))
    ids = pairs_of_gsplat(*drawn, width, height)
    image, alpha = gsplat.accumulate(means2d, conics, opacities, features, *ids, width, height)
    theirs = {"means2d": means2d, "image": image[..., :3], "depth": image[..., 3:], "alpha": alpha}
    for name, value in theirs.items():
        assert scenes.error(getattr(ours.out, name), value) < ROUNDING, name
    images = [theirs[name] for name in ("image", "alpha", "depth")]
    torch.autograd.backward(images, list(scenes.cotangents(ours.out)))
    for name, leaf in zip(scenes.NAMES, leaves, strict=True):
        assert scenes.error(ours.grads[name], leaf.grad) < ROUNDING, name


def pairs_of_gsplat(means2d, conics, opacities, depths, width, height):
    """Return (Gaussian, pixel, image) of every alpha >= 1/255, by image, pixel, depth."""
    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    d = torch.stack([x, y], -1).reshape(1, -1, 1, 2) - means2d[:, None]
    a, b, c = conics[:, None].unbind(-1)
    x, y = d.unbind(-1)
    alphas = opacities[:, None] * torch.exp(-0.5 * (a * x**2 + c * y**2) - b * x * y)
    order = depths.argsort(-1)
    drawn = torch.gather(alphas, 2, order[:, None].expand_as(alphas)) >= 1 / 255
    image, pixel, place = drawn.nonzero().unbind(1)
    return order[image, place], pixel, image
