"""A1, forward: what is drawn at the limits of numbers, sizes and shapes, by every backend in
float32 against float64.
"""

import functools
import itertools
import math

import pytest
import torch

from tests.helpers.splatting_contract import draw
from tests.helpers.splatting_scenes import (
    NAMES,
    NO_CUTOFFS,
    Cloud,
    cameras,
    equal,
    error,
    front_camera,
    hostile_cloud,
    one_gaussian,
    psnr,
    random_cloud,
    run,
)
from tests.stability.backends import BACKENDS, each_backend
from tests.stability.rows import row
from tests.stability.scenes import finite, joined, pixels, stack
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting import PRESETS, rasterize
from threestudio_gaussiandreamer.training.finite import require_finite
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

BACKGROUND = torch.tensor([0.2, 0.5, 0.9])


# ---- what is culled ------------------------------------------------------------------------------


@row("A1", "At/behind near plane; centred on the camera (z=0)")
@each_backend
def test_near_plane(backend, measured):
    """Everything is compared in float32: 0.01 is the nearest float to it, on both sides of the
    comparison.
    """
    near, scene = torch.tensor(0.01).item(), random_cloud(20, seed=1)
    scene.means[:, 2] += 3
    camera, wrong = front_camera(24, 16, 12.0), 0
    alone = draw(backend, scene, camera, 24, 16, BACKGROUND)
    offsets = [sign * 10.0**-k for k in range(1, 8) for sign in (-1, 1)]
    for z in (0.0, -0.0, -1.0, near, *(near + offset for offset in offsets)):
        one = one_gaussian((0.0, 0.0, z), scale=0.05)
        both = draw(backend, joined(one, scene), camera, 24, 16, BACKGROUND)
        assert finite(both)
        drawn = torch.tensor(z, dtype=torch.float32).item() > near
        wrong += drawn != (both.out.radii[0, 0].item() > 0)
        if not drawn:
            assert torch.equal(both.out.image, alone.out.image)
            assert all(
                (both.grads[name][0] == 0).all()
                and torch.equal(both.grads[name][1:], alone.grads[name])
                for name in NAMES
            )
    measured(wrong, "of 18", what="wrongly culled", at_most=0)


@row("A1", "Edge of image, huge Jacobian")
@each_backend
def test_spill_of_the_clamped_jacobian(backend, measured):
    """No pixel is drawn outside of the ellipse that the clamped formula gives, here written once
    more by hand.
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
            one_gaussian((x, 0.0, z), scale, 0.9),
            front_camera(width, width, focal),
            width,
            width,
        ).out
        spilt += int(((out.alpha[0, ..., 0] > 0) & ~inside).sum())
    measured(spilt, "pixels", what="spill", at_most=0)


@row("A1", "det <= 0, float32 cancellation ac-b^2")
@each_backend
def test_no_needle_is_lost_in_float32(backend, measured):
    """10 000 : 1 at any angle, from 1e-3 to 1e2 wide."""
    n, g = 600, torch.Generator().manual_seed(0)
    length = 10.0 ** (5 * torch.rand(n, 1, generator=g).double() - 3)
    cloud = random_cloud(n, seed=2)._replace(
        scales=length * torch.tensor([1.0, 1e-4, 1e-4]).double()
    )
    cloud.means[:] = torch.tensor([0.05, -0.1, 2.0])
    ours = draw(backend, cloud, front_camera(16, 16, 12.0), 16, 16).out.radii > 0
    truth = run(cloud, *front_camera(16, 16, 12.0), 16, 16, backend="reference").out.radii > 0
    measured((ours ^ truth).sum(), f"of {n}", what="lost or gained", at_most=0)


@row("A1", "Zero/denormal quaternion")
@each_backend
def test_quaternions_without_length(backend, measured):
    cloud, camera = random_cloud(30, seed=7), cameras(1, 20, 20)
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
    cloud, camera = random_cloud(30, seed=7).to(torch.float32), cameras(1, 20, 20)
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
def test_opacities_at_their_ends(backend, measured):
    """Stored logits: 0 and 1 become the bounds when loaded; too faint for a pixel is nothing in
    both passes.
    """
    geometry = GaussianCloud({})
    logits = torch.tensor([-math.inf, -40.0, -8.0, 0.0, 6.0, 40.0, math.inf])
    scene = random_cloud(7, seed=3).to(torch.float32)
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
    whole, camera = draw(backend, scene, cameras(2, 24, 16), 24, 16), cameras(2, 24, 16)
    rest = draw(backend, scene.pick(~faint), camera, 24, 16)
    assert finite(whole) and faint.sum() == 3 and torch.equal(whole.out.image, rest.out.image)
    assert all((whole.grads[name][faint] == 0).all() for name in NAMES)
    raw = scene._replace(opacities=torch.sigmoid(logits))  # and unclamped, as anyone may call it
    assert finite(draw(backend, raw, camera, 24, 16))
    measured("finite; nothing below alpha_min")


# ---- shapes and order ----------------------------------------------------------------------------


@functools.cache
def needles() -> list[tuple[Cloud, torch.Tensor]]:
    """Every multiset of three scales in five rotations, which are all orders of the axes, and its
    float64 alpha.
    """
    steps, g = (1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4), torch.Generator().manual_seed(2)
    clouds = []
    for scales in itertools.combinations_with_replacement(steps, 3):
        for quat in torch.randn(5, 4, generator=g):
            cloud = one_gaussian((0.1, -0.2, 2.0), scales, 0.8)._replace(quats=quat[None].double())
            out = rasterize(
                *cloud.to(torch.float32).to(torch.float64),
                *front_camera(16, 16, 20.0),
                16,
                16,
                backend="reference",
            )
            clouds.append((cloud, out.alpha))
    return clouds


@row("A1", "Needle, disc, scale 1e-8..1e4")
@each_backend
def test_needles_and_discs(backend, measured):
    """The truth sees the scales and quaternions as float32 rounds them; a pixel may fall on the
    other side of alpha_min.
    """
    worst = 0.0
    for cloud, truth in needles():
        alpha = draw(backend, cloud, front_camera(16, 16, 20.0), 16, 16).out.alpha.double()
        flipped = (alpha == 0) != (truth == 0)
        worst = max(worst, (alpha - truth).abs()[~flipped].max().item())
        assert (alpha - truth).abs().max() < 1.001 / 1024
    measured(worst, what="forward", at_most=2e-5)


@row("A1", "Needle, disc, scale 1e-8..1e4")
def test_log_scales_are_clamped_in_the_parameterisation(measured, caplog):
    """The float32 range of exp, with room for squares: nothing outside of [e^-20, e^10] leaves the
    geometry; said once.
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
def test_equal_depths_go_by_index(backend, measured):
    """64 in one plane: the picture is that of the permuted indices, in float64 by hand; the same
    bits over 10 runs.
    """
    cloud, camera = stack([0.9] * 64, scale=1.0), front_camera(8, 8, 4.0)
    colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for seed in range(3):
        order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
        results = [
            draw(backend, cloud._replace(colors=colors[order]), camera, 8, 8)
            for _ in range(10 if seed == 0 else 1)
        ]
        assert all(equal(results[0], other) for other in results[1:])
        alpha = results[0].out.alpha[0, 4, 4, 0].item()
        first = 0.9 * math.exp(
            -0.5 * 0.5 / (2**2 + 0.3)
        )  # half a pixel off in both directions, 2 pixels wide
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
def test_the_order_is_that_of_floats(backend, measured):
    """Neighbouring floats, and twenty orders of magnitude up to the far plane, shuffled."""
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
    truth = run(
        cloud, *front_camera(4, 4, 3.0), 4, 4, backend="reference", stop=0.0
    )  # already in order
    shuffled = draw(backend, cloud.pick(order), front_camera(4, 4, 3.0), 4, 4, stop=0.0)
    measured(error(shuffled.out.image, truth.out.image), what="error", at_most=1e-5)
    measured(
        error(shuffled.out.contribution, truth.out.contribution[:, order]),
        what="error of contributions",
        at_most=1e-5,
    )


# ---- transparency --------------------------------------------------------------------------------


def fog(n: int) -> Cloud:
    return random_cloud(n, seed=8, size=0.4)._replace(
        opacities=torch.full((n,), 0.0038, dtype=torch.float64)
    )


@row("A1", "Fog: thousands of faint Gaussians on a pixel")
@each_backend
def test_fog(backend, measured):
    """Each Gaussian of opacity o loses what lies below alpha_min, the share alpha_min / o of it: at
    most N alpha_min in a pixel.
    """
    n, camera = 2000, cameras(1, 12, 12)
    cloud = random_cloud(n, seed=8, size=0.4)._replace(
        opacities=torch.full((n,), 0.0038, dtype=torch.float64)
    )
    truth = run(cloud, *camera, 12, 12, backend="reference", **NO_CUTOFFS).out.image
    images = {name: draw(backend, cloud, camera, 12, 12, preset=name).out.image for name in PRESETS}
    for name, alpha_min in PRESETS.items():
        assert (images[name] - truth).abs().max() <= n * alpha_min
    measured(psnr(images["accurate"], truth), "dB", what="accurate", at_least=60)
    measured(psnr(images["balanced"], truth), "dB", what="balanced")
    measured(psnr(images["fast"], truth), "dB", what="fast")


@row("A1", "Early stop")
@each_backend
def test_early_stop(backend, measured):
    out = draw(
        backend,
        stack([0.9, 0.905, 0.99, 0.5], scale=10.0),
        front_camera(1, 1, 1.0),
        1,
        1,
        torch.ones(3),
    ).out
    everything = 1 - 0.1 * 0.095 * 0.01 * 0.5
    measured(abs(out.alpha.item() - everything), what="error", at_most=1e-4)
    assert out.contribution[0, 3] == 0


# ---- sizes ---------------------------------------------------------------------------------------


@row("A1", "0, 1, 2, 3 Gaussians; empty view; all culled")
@each_backend
def test_nothing_to_see(backend, measured):
    away = random_cloud(5)._replace(means=torch.full((5, 3), 100.0).double())
    for cloud in (random_cloud(0), away):
        result = draw(backend, cloud, cameras(2, 10, 8), 10, 8, BACKGROUND)
        assert (
            torch.equal(result.out.image, BACKGROUND.expand(2, 8, 10, 3))
            and (result.out.alpha == 0).all()
        )
        assert all(
            torch.equal(result.grads[name], torch.zeros(leaf.shape))
            for name, leaf in zip(NAMES, cloud, strict=True)
        )
    for n in range(4):
        leaves = random_cloud(n).to(torch.float32).leaves()
        optimizer = torch.optim.Adam(leaves, lr=0.1)
        rasterize(
            *leaves, *cameras(1, 10, 8, dtype=torch.float32), 10, 8, backend=backend
        ).image.sum().backward()
        optimizer.step()
        assert all(leaf.isfinite().all() for leaf in leaves)
    measured("bit for bit")


@row(
    "A1",
    "Tiny, non-square, non-multiple of tile",
    bar="crop of a larger render to 5e-6 in float32; circle's axes within 0.5 px",
)
@each_backend
@pytest.mark.parametrize("width, height", [(1, 1), (1, 7), (17, 33), (31, 16), (1024, 1)])
def test_any_size_is_a_crop_of_a_larger_one(backend, width, height, measured):
    """1e-6 is below the rounding of where things are: a coordinate of 40 pixels is a float32 to
    4e-6 pixels.

    A Gaussian one pixel wide changes by 0.6 of its opacity per pixel, 2e-6, and several lie on each
    pixel; in float64 the crop is exact to 1e-12 (test_splatting_reference.py). The principal point
    moves the window. All means lie in it: beyond 1.3 of it the Jacobian is clamped, by definition
    of the image model in each image by its own size, so a crop differs there."""
    g, focal = torch.Generator().manual_seed(0), 50.0
    cloud = random_cloud(60, seed=6, size=0.03)
    at = torch.rand(60, 2, generator=g).double() * torch.tensor([width, height])
    depth = 2 + torch.rand(60, 1, generator=g).double()
    cloud = cloud._replace(
        means=torch.cat([(at - torch.tensor([width, height]) / 2) / focal * depth, depth], 1)
    )
    viewmats, Ks = front_camera(width, height, focal)
    moved = Ks.clone()
    moved[0, :2, 2] += torch.tensor([9.0, 5.0])
    small = draw(backend, cloud, (viewmats, Ks), width, height, BACKGROUND).out
    large = draw(backend, cloud, (viewmats, moved), width + 16, height + 11, BACKGROUND).out
    window = large.image[:, 5 : 5 + height, 9 : 9 + width]
    measured((small.image - window).abs().max(), what="crop", at_most=5e-6)


@row("A1", "Tiny, non-square, non-multiple of tile")
@each_backend
def test_a_circle_is_round_on_a_wide_image(backend, measured):
    alpha = draw(backend, one_gaussian(scale=0.2), front_camera(128, 64, 80.0), 128, 64).out.alpha[
        0, ..., 0
    ]
    across, down = (2 * float((alpha.sum(axis) > 0).sum()) / 2 for axis in (0, 1))
    measured(abs(across - down), "px", what="axes", at_most=0.5)


# ---- kinds of numbers ----------------------------------------------------------------------------


@row("A1", "autocast / fp16 / bf16 inputs")
@each_backend
def test_other_precisions(backend, measured):
    cloud, camera = random_cloud(20).to(torch.float32), cameras(2, 10, 8)
    plain = draw(backend, cloud, camera, 10, 8)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = draw(backend, cloud, camera, 10, 8)
    assert equal(plain, cast) and cast.out.image.dtype == torch.float32
    for dtype in (torch.float16, torch.bfloat16):
        camera32 = [x.to(torch.float32) for x in camera]
        half = rasterize(*cloud.to(dtype), *camera32, 10, 8, backend=backend).image
        rounded = rasterize(
            *cloud.to(dtype).to(torch.float32), *camera32, 10, 8, backend=backend
        ).image
        assert half.dtype == torch.float32 and torch.equal(half, rounded)
    measured("float32, same bits")


@row("A1", "NaN/Inf inputs")
@each_backend
def test_a_poisoned_gaussian_changes_no_bit_of_the_others(backend, measured):
    cloud, camera, rest = random_cloud(300, seed=6), cameras(2, 40, 24), torch.arange(300) != 7
    without = draw(backend, cloud.pick(rest), camera, 40, 24)
    for name, value in itertools.product(NAMES, (math.nan, math.inf, -math.inf)):
        poisoned = Cloud(*(x.clone() for x in cloud))
        getattr(poisoned, name)[7] = value
        with_it = draw(backend, poisoned, camera, 40, 24)
        assert torch.equal(with_it.out.image, without.out.image) and torch.equal(
            with_it.out.alpha, without.out.alpha
        )
        assert all(torch.equal(with_it.grads[other][rest], without.grads[other]) for other in NAMES)
        assert all((with_it.grads[other][7] == 0).all() for other in NAMES)
    measured("drop: bit-identical")


@row("A1", "NaN/Inf inputs")
def test_training_stops_where_the_cloud_is_not_finite(measured):
    geometry = GaussianCloud({})
    geometry._allocate(3)
    with torch.no_grad():
        geometry.sh0[2, 0, 1] = math.nan
    with pytest.raises(UserError, match="1 of the 9 numbers of sh0"):
        require_finite(geometry.named_parameters(), step=25)
    measured("training stops, and names the parameter")


@row("A1", "NaN/Inf inputs")
def test_a_poisoned_gaussian_is_named(measured):
    """Attribute, how many, and where the first one is."""
    cloud, camera = (
        random_cloud(300, seed=6).to(torch.float32),
        cameras(1, 8, 8, dtype=torch.float32),
    )
    for name in NAMES:
        poisoned = Cloud(*(x.clone() for x in cloud))
        getattr(poisoned, name)[[7, 9]] = math.nan
        count = getattr(poisoned, name)[[7, 9]].numel()
        with pytest.raises(UserError, match=rf"{name} holds {count} .*\(7") as caught:
            rasterize(*poisoned, *camera, 8, 8, non_finite="error")
        assert "nan" in str(caught.value)
    measured("error: named with count and index")


@row(
    "A1",
    "int32 overflow",
    bar="600 k over all of 8192 x 8192: the exact memory in a named error, none allocated",
)
@pytest.mark.skipif("cpu" not in BACKENDS, reason="the kernel isn't built")
def test_more_tile_intersections_than_32_bits_count(measured):
    """At 1024 x 1024 the kernel's 32-pixel tiles make 6e8 pairs, which fit; here they are 3.9e10,
    beyond any machine's memory.

    Each pair takes 80 bytes: an entry, its block mask, and the row of its gradient sums.
    """
    n = 600_000
    cloud = Cloud(*(x.expand(n, *x.shape[1:]) for x in one_gaussian(scale=1e4).to(torch.float32)))
    with pytest.raises(UserError, match=r"cover so many tiles .*GiB") as caught, torch.no_grad():
        rasterize(
            *cloud, *front_camera(8192, 8192, 5000.0, torch.float32), 8192, 8192, backend="cpu"
        )
    needed = float(str(caught.value).split("needs ")[1].split(" GiB")[0])
    measured(
        needed / (n * 256 * 256 * 80 / 2**30),
        "of the true size",
        what="count",
        at_most=1.0001,
        at_least=0.9999,
    )


# ---- hostile clouds, all at once -----------------------------------------------------------------


@row("A1", "NaN/Inf inputs")
@each_backend
def test_hostile_clouds_give_finite_pictures_and_gradients(backend, measured):
    drawn = 0
    for seed in range(20):
        cloud = hostile_cloud(seed, 50)
        assert finite(
            draw(
                backend,
                cloud,
                cameras(2, 24, 16),
                24,
                16,
                antialias=bool(seed % 2),
                camera_gradient=True,
            )
        )
        drawn += 50
    measured(0, f"of {drawn} hostile", what="not finite")
