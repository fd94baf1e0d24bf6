"""A0: faults of other rasterisers. Each test holds ours to the bar and shows that an emulation of
the fault breaks it.
"""

import math

import numpy as np
import pytest
import torch

from tests.helpers.splatting_scenes import (
    NO_CUTOFFS,
    Cloud,
    cameras,
    front_camera,
    one_gaussian,
    psnr,
    random_cloud,
    rasterize,
)
from tests.stability.backends import each_backend
from tests.stability.faults_rasteriser_cases import central_difference, single, slope_error
from tests.stability.rows import row
from tests.stability.scenes import clamped_alpha, clamped_slope, plain_image, stack
from threestudio_gaussiandreamer.gaussians.grow import nearest_distance_scales
from threestudio_gaussiandreamer.splatting import tiles
from threestudio_gaussiandreamer.splatting.projection import quats_to_rotations


@row("A0", "F1")
@each_backend
def test_f1_the_clamp_of_the_jacobian_depends_on_depth(backend, fault):
    """At twice the half-width of the image; the emulation treats the clamped x = lim z as a
    constant, without its derivative by z.
    """
    width, focal, scales = 32, 20.0, torch.tensor([1.5, 0.8, 0.4]).double()

    def by_hand(z, slope_of=clamped_slope):
        return (
            clamped_alpha(
                torch.stack([x * torch.ones_like(z), 0.1 * torch.ones_like(z), z]),
                scales,
                width,
                focal,
                0.7,
                slope_of,
            )
        ).sum()

    def constant_x(x, z, limit):
        inside = (x / z).abs() < limit
        return torch.where(inside, x, (torch.clamp(x / z, -limit, limit) * z).detach()) / z

    def ours(z):
        cloud = one_gaussian(scale=tuple(scales.tolist()), opacity=0.7)
        means = torch.stack([x * torch.ones_like(z), 0.1 * torch.ones_like(z), z])[None]
        arguments = [
            a.to(torch.float32) for a in (means, *cloud[1:], *front_camera(width, width, focal))
        ]
        return (
            rasterize(*arguments, width, width, backend=backend, **NO_CUTOFFS).alpha.double().sum()
        )

    x = 3.2
    fault(
        lambda f: slope_error(f, 2.0, by_hand),
        ours=ours,
        emulation=lambda z: by_hand(z, constant_x),
        at_most=1e-4,
        unit="relative",
    )


@row("A0", "F2")
@each_backend
def test_f2_no_gaussians_show_the_background(backend, fault):
    background = torch.tensor([0.2, 0.5, 0.9])

    def ours(cloud: Cloud) -> torch.Tensor:
        leaves = cloud.to(torch.float32).leaves()
        image = rasterize(
            *leaves, *single(cameras(1, 8, 6)), 8, 6, background=background, backend=backend
        ).image
        image.sum().backward()
        assert all(leaf.grad.shape == leaf.shape for leaf in leaves)
        return image

    def black_unless_there_are_some(cloud: Cloud) -> torch.Tensor:
        image = torch.zeros(1, 6, 8, 3)
        return image if len(cloud.means) == 0 else ours(cloud)

    fault(
        lambda draw: (draw(random_cloud(0)) - background).abs().max(),
        ours=ours,
        emulation=black_unless_there_are_some,
    )


@row("A0", "F3")
@each_backend
def test_f3_no_gradient_flows_through_the_cap(backend, fault):
    """Opacity 0.95 under a cap of 0.5: an increase changes nothing. The emulation caps the value
    but passes the gradient.
    """
    cloud = one_gaussian(scale=5.0)

    def ours(opacity):
        camera = single(front_camera(2, 2, 4.0))
        arguments = [x.to(torch.float32) for x in (*cloud[:3], opacity[None], cloud.colors)]
        return (
            rasterize(*arguments, *camera, 2, 2, alpha_max=0.5, backend=backend)
            .alpha.double()
            .sum()
        )

    def through_the_cap(opacity):
        alpha = opacity * torch.ones(2, 2)
        return (alpha + (alpha.clamp(max=0.5) - alpha).detach()).sum()

    def deviation(f):
        leaf = torch.tensor(0.95, dtype=torch.float64).requires_grad_()
        (slope,) = torch.autograd.grad(f(leaf), leaf)
        return abs(slope.item() - central_difference(f, 0.95, 1e-3))

    fault(deviation, ours=ours, emulation=through_the_cap, at_most=1e-3)


@row("A0", "F4")
@each_backend
def test_f4_the_gaussian_that_crosses_the_stop_counts(backend, fault):
    opacities = [0.9, 0.905, 0.99]

    def ours(opacities):
        cloud = stack(opacities, scale=10.0).to(torch.float32)
        return rasterize(
            *cloud, *single(front_camera(1, 1, 1.0)), 1, 1, backend=backend
        ).alpha.item()

    def stops_before(opacities):
        T = 1.0
        for alpha in opacities:
            if T * (1 - alpha) < 1e-4:
                break
            T *= 1 - alpha
        return 1 - T

    everything = 1 - np.prod(1 - np.array(opacities))
    fault(
        lambda f: abs(f(opacities) - everything),
        ours=ours,
        emulation=stops_before,
        at_most=1e-4,
        unit="of alpha",
    )


@row("A0", "F5")
@each_backend
def test_f5_the_threshold_of_alpha(backend, fault):
    """4000 Gaussians of opacity 0.1 on a sphere, like an initial cloud. The emulation uses the
    common threshold of 1/255.
    """
    g = torch.Generator().manual_seed(0)
    means = torch.nn.functional.normalize(torch.randn(4000, 3, generator=g), dim=1)
    cloud = random_cloud(4000, seed=1)._replace(
        means=means.double(), scales=torch.full((4000, 3), 0.03).double()
    )
    cloud = cloud._replace(opacities=torch.full((4000,), 0.1).double()).to(torch.float32)
    camera = single(cameras(1, 64, 64))

    def drawn(**options):
        with torch.no_grad():
            return rasterize(*cloud, *camera, 64, 64, **{"backend": backend, **options}).image

    truth = drawn(**NO_CUTOFFS, backend="torch")
    fault(
        lambda f: psnr(f(), truth),
        ours=drawn,
        emulation=lambda: drawn(alpha_min=1 / 255),
        at_least=55,
        unit="dB",
    )


@row("A0", "F6")
@each_backend
@pytest.mark.parametrize(
    "attribute, value", [("means", math.nan), ("scales", math.inf), ("opacities", math.nan)]
)
def test_f6_what_is_not_finite_is_culled(backend, attribute, value, fault):
    """The emulation culls what is before the near plane or without area; both comparisons are false
    for NaN.
    """
    scene = random_cloud(6, seed=2)
    scene.means[:, 2] += 3
    corrupted = Cloud(*(torch.cat([x, x[:1].clone()]) for x in scene))
    getattr(corrupted, attribute)[6] = value

    def ours(cloud):
        leaves = cloud.to(torch.float32).leaves()
        image = rasterize(*leaves, *single(front_camera(10, 8, 8.0)), 10, 8, backend=backend).image
        image.square().sum().backward()
        return [image.detach(), *(leaf.grad[:6] for leaf in leaves)]

    def comparisons_that_nan_passes(cloud):
        leaves = cloud.leaves()
        z, det = leaves.means[:, 2], leaves.scales[:, 0] ** 2
        image = plain_image(
            leaves, 10, 8, 8.0, ~(z <= 0.2) & ~(det == 0), z.detach().argsort(stable=True)
        )
        image.square().sum().backward()
        return [image.detach(), *(leaf.grad[:6] for leaf in leaves if leaf.grad is not None)]

    def changed(draw):
        return sum(float((a != b).sum()) for a, b in zip(draw(corrupted), draw(scene), strict=True))

    fault(changed, ours=ours, emulation=comparisons_that_nan_passes, unit="numbers changed")


@row("A0", "F7")
def test_f7_a_zero_quaternion_is_no_rotation(fault):
    def divided_by_the_norm(q):
        w, x, y, z = (q * q.square().sum(-1, keepdim=True).rsqrt()).unbind(-1)
        diagonal = torch.stack(
            [1 - 2 * (y * y + z * z), 1 - 2 * (x * x + z * z), 1 - 2 * (x * x + y * y)], -1
        )
        return torch.diag_embed(diagonal)

    def deviation(rotation):
        quats = torch.tensor([[0.0, 0, 0, 0], [1e-30, 0, 0, 0]], requires_grad=True)
        matrices = rotation(quats)
        matrices.sum().backward()
        good = (matrices.detach() == torch.eye(3)).all(-1).all(-1) & (quats.grad == 0).all(-1)
        return (~good).sum()

    fault(deviation, ours=quats_to_rotations, emulation=divided_by_the_norm, unit="of 2 wrong")


@row("A0", "F8")
def test_f8_tile_intersections_are_counted_in_64_bits(fault):
    """524 288 Gaussians over all of 1024 x 1024 give 2^31 intersections with tiles of 16 pixels;
    our tiles are smaller, so the count is larger.
    """
    n = 524_288

    def ours(side):
        bounds = tiles.Bounds(
            torch.empty(6, 0),
            torch.tensor([[0], [0], [side], [side]]).expand(4, n),
            torch.zeros(n).long(),
        )
        return sum((last - first) * side * side for first, last in tiles.slices(bounds))

    def in_32_bits(side):
        with np.errstate(over="ignore"):
            return int(np.full(n, side * side, np.int32).cumsum(dtype=np.int32)[-1])

    fault(
        lambda count: abs(count(64) / (n * 64 * 64) - 1),
        ours=ours,
        emulation=in_32_bits,
        unit="relative",
    )


@row("A0", "F9")
@pytest.mark.parametrize("n", [1, 2, 3])
def test_f9_first_scales_of_very_few_points(n, fault):
    points = np.eye(3, dtype=np.float32)[:n]

    def three_nearest_or_the_largest_float(points):
        distances = ((points[:, None] - points) ** 2).sum(-1) + np.diag([np.inf] * n)
        best = np.full((n, 3), np.finfo(np.float32).max, np.float32)
        best[:, : n - 1] = np.sort(distances)[:, : n - 1]
        with np.errstate(over="ignore"):
            return np.sqrt(best.sum(1, dtype=np.float32) / 3)

    def deviation(scales_of):
        log_scales = np.log(scales_of(points))
        return (~(np.isfinite(log_scales) & (np.abs(log_scales) < 20))).sum()

    fault(
        deviation,
        ours=nearest_distance_scales,
        emulation=three_nearest_or_the_largest_float,
        unit="infinite scales",
    )
