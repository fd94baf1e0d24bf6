"""A1, forward: renders at the limits of numbers, sizes and shapes, by every backend, float32
against float64.
"""

import functools
import itertools
import math

import pytest
import torch

from tests.helpers import splatting_scenes as scenes
from tests.helpers.splatting_draws import draw
from tests.helpers.splatting_scenes import rasterize
from tests.stability.backends import each_backend
from tests.stability.rasteriser_cases import BACKGROUND
from tests.stability.rows import row
from tests.stability.scenes import finite, joined, pixels, stack
from threestudio_gaussiandreamer.splatting import PRESETS
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

# ---- what is culled ------------------------------------------------------------------------------


@row("A1", "At/behind near plane; centred on the camera (z=0)")
@each_backend
def test_near_plane(backend, measured):
    """All comparisons use float32: 0.01 means the nearest float to it, on both sides."""
    near, scene = torch.tensor(0.01).item(), scenes.random_cloud(20, seed=1)
    scene.means[:, 2] += 3
    camera, wrong = scenes.front_camera(24, 16, 12.0), 0
    alone = draw(backend, scene, camera, 24, 16, BACKGROUND)
    offsets = [sign * 10.0**-k for k in range(1, 8) for sign in (-1, 1)]
    for z in (0.0, -0.0, -1.0, near, *(near + offset for offset in offsets)):
        one = scenes.one_gaussian((0.0, 0.0, z), scale=0.05)
        both = draw(backend, joined(one, scene), camera, 24, 16, BACKGROUND)
        assert finite(both)
        drawn = torch.tensor(z, dtype=torch.float32).item() > near
        wrong += drawn != (both.out.radii[0, 0].item() > 0)
        if not drawn:
            assert torch.equal(both.out.image, alone.out.image)
            assert all(
                (both.grads[name][0] == 0).all()
                and torch.equal(both.grads[name][1:], alone.grads[name])
                for name in scenes.NAMES
            )
    measured(wrong, "of 18", what="wrongly culled", at_most=0)


@row("A1", "Edge of image, huge Jacobian")
@each_backend
def test_spill_of_the_clamped_jacobian(backend, measured):
    """No pixel outside the ellipse of the clamped formula is covered; the formula is
    repeated here.
    """
    width, focal, z, spilt = 32, 20.0, 2.0, 0
    for limits, scale in itertools.product(
        (0.99, 1.0, 1.29, 1.3, 1.31, 5.0, 50.0), (0.01, 0.1, 1.0)
    ):
        limit = 0.5 * width / focal
        x = limits * limit * z
        J = torch.tensor(
            [[focal / z, 0, -focal / z * min(x / z, 1.3 * limit)], [0, focal / z, 0]]
        ).double()
        covariance = scale**2 * J @ J.T + 0.3 * torch.eye(2)
        offsets = pixels(width, width) - torch.tensor([focal * x / z, 0.0]).double() - 0.5 * width
        inside = (
            0.9 * torch.exp(-0.5 * (offsets @ covariance.inverse() * offsets).sum(-1))
            >= 1 / 1024 - 1e-6
        )  # rounding
        out = draw(
            backend,
            scenes.one_gaussian((x, 0.0, z), scale, 0.9),
            scenes.front_camera(width, width, focal),
            width,
            width,
        ).out
        spilt += int(((out.alpha[0, ..., 0] > 0) & ~inside).sum())
    measured(spilt, "pixels", what="spill", at_most=0)


@row("A1", "det <= 0, float32 cancellation ac-b^2")
@each_backend
def test_no_needle_is_lost_in_float32(backend, measured):
    """Aspect ratio 10 000 : 1 at any angle, from 1e-3 to 1e2 wide."""
    n, g = 600, torch.Generator().manual_seed(0)
    length = 10.0 ** (5 * torch.rand(n, 1, generator=g).double() - 3)
    cloud = scenes.random_cloud(n, seed=2)._replace(
        scales=length * torch.tensor([1.0, 1e-4, 1e-4]).double()
    )
    cloud.means[:] = torch.tensor([0.05, -0.1, 2.0])
    ours = draw(backend, cloud, scenes.front_camera(16, 16, 12.0), 16, 16).out.radii > 0
    truth = (
        scenes.run(cloud, *scenes.front_camera(16, 16, 12.0), 16, 16, backend="reference").out.radii
        > 0
    )
    measured((ours ^ truth).sum(), f"of {n}", what="lost or gained", at_most=0)


@row("A1", "Zero/denormal quaternion")
@each_backend
def test_zero_and_denormal_quaternions(backend, measured):
    cloud, camera = scenes.random_cloud(30, seed=7), scenes.cameras(1, 20, 20)
    identity = draw(
        backend, cloud._replace(quats=torch.tensor([[1.0, 0, 0, 0]]).repeat(30, 1)), camera, 20, 20
    )
    for tiny in (0.0, 1e-20, 1e-38, 1e-42):
        none = draw(backend, cloud._replace(quats=torch.full((30, 4), tiny)), camera, 20, 20)
        assert (
            torch.equal(none.out.image, identity.out.image)
            and (none.grads["quats"] == 0).all()
            and finite(none)
        )
    measured("identity, gradient 0, no NaN below 1e-12")


@row("A1", "Zero/denormal quaternion", bar="q, -q, 4q: the same bits; 5q, 1e20 q: within 1e-6")
@each_backend
def test_the_length_of_a_quaternion_changes_nothing(backend, measured):
    """ "Identical" can't hold to the bit for 5q: the product itself rounds in float32, so it is
    another rotation by up to 6e-8.

    For -q and for powers of two the product is exact, and so is the picture.
    """
    cloud, camera = scenes.random_cloud(30, seed=7).to(torch.float32), scenes.cameras(1, 20, 20)
    once = draw(backend, cloud, camera, 20, 20).out.image
    for factor in (-1.0, 4.0, 2.0**-30):
        assert torch.equal(
            draw(backend, cloud._replace(quats=cloud.quats * factor), camera, 20, 20).out.image,
            once,
        )
    for factor in (5.0, 1e20):
        other = draw(backend, cloud._replace(quats=cloud.quats * factor), camera, 20, 20).out.image
        measured((other - once).abs().max(), what="largest difference", at_most=1e-6)


@row("A1", "Opacity -> 0 and -> 1")
@each_backend
def test_opacities_near_0_and_1(backend, measured):
    """Stored logits: 0 and 1 become the bounds when loaded; a Gaussian below the threshold is
    skipped in both passes.
    """
    geometry = GaussianCloud({})
    logits = torch.tensor([-math.inf, -40.0, -8.0, 0.0, 6.0, 40.0, math.inf])
    scene = scenes.random_cloud(7, seed=3).to(torch.float32)
    arrays = {
        "means": scene.means,
        "log_scales": scene.scales.log(),
        "quats": scene.quats,
        "logit_opacities": logits,
    }
    geometry.set_arrays(**arrays, sh=torch.zeros(7, 1, 3))
    assert (
        geometry.logit_opacities.detach().min() == -15
        and geometry.logit_opacities.detach().max() == 15
    )
    faint = geometry.opacities().detach() < 1 / 1024
    scene = scene._replace(opacities=geometry.opacities().detach())
    whole, camera = (
        draw(backend, scene, scenes.cameras(2, 24, 16), 24, 16),
        scenes.cameras(2, 24, 16),
    )
    rest = draw(backend, scene.pick(~faint), camera, 24, 16)
    assert finite(whole) and faint.sum() == 3 and torch.equal(whole.out.image, rest.out.image)
    assert all((whole.grads[name][faint] == 0).all() for name in scenes.NAMES)
    raw = scene._replace(opacities=torch.sigmoid(logits))  # and unclamped, as the function accepts
    assert finite(draw(backend, raw, camera, 24, 16))
    measured("finite; nothing below alpha_min")


# ---- shapes and order ----------------------------------------------------------------------------


@functools.cache
def needles() -> list[tuple[scenes.Cloud, torch.Tensor]]:
    """Return every multiset of three scales in five rotations, which cover all orders of the axes,
    and their float64 alpha.
    """
    steps, g = (1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4), torch.Generator().manual_seed(2)
    clouds = []
    for scales in itertools.combinations_with_replacement(steps, 3):
        for quat in torch.randn(5, 4, generator=g):
            cloud = scenes.one_gaussian((0.1, -0.2, 2.0), scales, 0.8)._replace(
                quats=quat[None].double()
            )
            out = rasterize(
                *cloud.to(torch.float32).to(torch.float64),
                *scenes.front_camera(16, 16, 20.0),
                16,
                16,
                backend="reference",
            )
            clouds.append((cloud, out.alpha))
    return clouds


@row("A1", "Needle, disc, scale 1e-8..1e4")
@each_backend
def test_needles_and_discs(backend, measured):
    """The reference uses scales and quaternions rounded to float32; a pixel may fall on the other
    side of alpha_min.
    """
    worst = 0.0
    for cloud, truth in needles():
        alpha = draw(backend, cloud, scenes.front_camera(16, 16, 20.0), 16, 16).out.alpha.double()
        flipped = (alpha == 0) != (truth == 0)
        worst = max(worst, (alpha - truth).abs()[~flipped].max().item())
        assert (alpha - truth).abs().max() < 1.001 / 1024
    measured(worst, what="forward", at_most=2e-5)


@row("A1", "Needle, disc, scale 1e-8..1e4")
def test_log_scales_are_clamped_in_the_parameterisation(measured, caplog):
    """To the float32 range of exp, with room for squares: scales stay in [e^-20, e^10], and a
    warning is logged once.
    """
    geometry = GaussianCloud({})
    zeros = torch.zeros(3, 3)
    geometry.set_arrays(
        means=zeros,
        log_scales=zeros,
        quats=torch.ones(3, 4),
        logit_opacities=torch.zeros(3),
        sh=torch.zeros(3, 1, 3),
    )
    geometry.warn_of_clamped_sizes()
    assert not caplog.records
    with torch.no_grad():
        geometry.log_scales[:2] = torch.tensor([[-1e3], [1e3]])
    low, high, _ = geometry.scales().detach()
    assert torch.allclose(low.log(), torch.tensor(-20.0)) and torch.allclose(
        high.log(), torch.tensor(10.0)
    )
    for _ in range(2):
        geometry.warn_of_clamped_sizes()
    assert len(caplog.records) == 1 and "2 of 3" in caplog.text
    measured("log scales in [-20, 10], warned once")


@row("A1", "Coincident depths")
@each_backend
def test_equal_depths_are_ordered_by_index(backend, measured):
    """64 Gaussians in one plane: the image is that of the permuted indices, computed in float64;
    equal bits over 10 runs.
    """
    cloud, camera = stack([0.9] * 64, scale=1.0), scenes.front_camera(8, 8, 4.0)
    colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for seed in range(3):
        order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
        results = [
            draw(backend, cloud._replace(colors=colors[order]), camera, 8, 8)
            for _ in range(10 if seed == 0 else 1)
        ]
        assert all(scenes.equal(results[0], other) for other in results[1:])
        alpha = results[0].out.alpha[0, 4, 4, 0].item()
        first = 0.9 * math.exp(
            -0.5 * 0.5 / (2**2 + 0.3)
        )  # offset by half a pixel in both directions, 2 pixels wide
        T = first * (1 - first) ** torch.arange(64).double()
        T[(1 - first) ** torch.arange(64).double() < 1e-4] = 0
        by_hand = (T[:, None] * colors[order]).sum(0)
        measured(
            (results[0].out.image[0, 4, 4] - by_hand).abs().max(),
            what="distance from the order by index",
            at_most=1e-6,
        )
        assert alpha == pytest.approx(T.sum().item(), abs=1e-6)


@row("A1", "Depth key: float bits as uint")
@each_backend
def test_the_depth_order_is_that_of_floats(backend, measured):
    """Adjacent floats, and twenty orders of magnitude up to the far plane, shuffled."""
    depths = [torch.tensor(2.0)]
    for i in range(1, 60):
        depths.append(
            torch.nextafter(depths[-1], torch.tensor(1e9)) if i < 20 else depths[-1] * 1.7
        )
    depths, order = (
        torch.stack(depths).double(),
        torch.randperm(60, generator=torch.Generator().manual_seed(0)),
    )
    cloud = stack([0.05] * 60)._replace(
        colors=torch.rand(60, 3, generator=torch.Generator().manual_seed(1)).double()
    )
    cloud = cloud._replace(
        means=depths[:, None] * torch.tensor([0, 0, 1.0]).double(),
        scales=0.2 * depths[:, None].repeat(1, 3),
    )
    truth = scenes.run(
        cloud, *scenes.front_camera(4, 4, 3.0), 4, 4, backend="reference", stop=0.0
    )  # already in order
    shuffled = draw(backend, cloud.pick(order), scenes.front_camera(4, 4, 3.0), 4, 4, stop=0.0)
    measured(scenes.error(shuffled.out.image, truth.out.image), what="error", at_most=1e-5)
    measured(
        scenes.error(shuffled.out.contribution, truth.out.contribution[:, order]),
        what="error of contributions",
        at_most=1e-5,
    )


# ---- transparency --------------------------------------------------------------------------------


def fog(n: int) -> scenes.Cloud:
    return scenes.random_cloud(n, seed=8, size=0.4)._replace(
        opacities=torch.full((n,), 0.0038, dtype=torch.float64)
    )


@row("A1", "Fog: thousands of faint Gaussians on a pixel")
@each_backend
def test_fog(backend, measured):
    """Each Gaussian of opacity o loses the fraction alpha_min / o, which is below the threshold: at
    most N alpha_min per pixel.
    """
    n, camera = 2000, scenes.cameras(1, 12, 12)
    cloud = scenes.random_cloud(n, seed=8, size=0.4)._replace(
        opacities=torch.full((n,), 0.0038, dtype=torch.float64)
    )
    truth = scenes.run(cloud, *camera, 12, 12, backend="reference", **scenes.NO_CUTOFFS).out.image
    images = {name: draw(backend, cloud, camera, 12, 12, preset=name).out.image for name in PRESETS}
    for name, alpha_min in PRESETS.items():
        assert (images[name] - truth).abs().max() <= n * alpha_min
    measured(scenes.psnr(images["accurate"], truth), "dB", what="accurate", at_least=60)
    measured(scenes.psnr(images["balanced"], truth), "dB", what="balanced")
    measured(scenes.psnr(images["fast"], truth), "dB", what="fast")


@row("A1", "Early stop")
@each_backend
def test_early_stop(backend, measured):
    out = draw(
        backend,
        stack([0.9, 0.905, 0.99, 0.5], scale=10.0),
        scenes.front_camera(1, 1, 1.0),
        1,
        1,
        torch.ones(3),
    ).out
    everything = 1 - 0.1 * 0.095 * 0.01 * 0.5
    measured(abs(out.alpha.item() - everything), what="error", at_most=1e-4)
    assert out.contribution[0, 3] == 0
