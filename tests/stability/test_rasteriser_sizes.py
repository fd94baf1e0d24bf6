"""Rendering at any size, with any values, and of extreme clouds."""

import itertools
import math
from pathlib import Path

import pytest
import torch

from tests.helpers.splatting_draws import draw
from tests.helpers.splatting_scenes import (
    NAMES,
    Cloud,
    cameras,
    equal,
    extreme_cloud,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
)
from tests.stability.backends import BACKENDS, each_backend
from tests.stability.rasteriser_cases import BACKGROUND
from tests.stability.rows import row
from tests.stability.scenes import finite
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu
from threestudio_gaussiandreamer.training.finite import require_finite
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

# ---- sizes ---------------------------------------------------------------------------------------


@row("A1", "0, 1, 2, 3 Gaussians; empty view; all culled")
@each_backend
def test_empty_views(backend, measured):
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
    """1e-6 is below the rounding of positions: a coordinate of 40 pixels has a float32 spacing of
    4e-6 pixels. A Gaussian one pixel wide changes by 0.6 of its opacity per pixel, 2e-6, and
    several overlap at each pixel; in float64 the crop is exact to 1e-12
    (test_splatting_reference.py).

    The principal point moves the window. All means are inside it: beyond 1.3 of the half-width the
    Jacobian is clamped by each image's own size, so a crop would differ there.
    """
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
def test_a_non_finite_gaussian_changes_no_bit_of_the_others(backend, measured):
    cloud, camera, rest = random_cloud(300, seed=6), cameras(2, 40, 24), torch.arange(300) != 7
    without = draw(backend, cloud.pick(rest), camera, 40, 24)
    for name, value in itertools.product(NAMES, (math.nan, math.inf, -math.inf)):
        corrupted = Cloud(*(x.clone() for x in cloud))
        getattr(corrupted, name)[7] = value
        with_it = draw(backend, corrupted, camera, 40, 24)
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
def test_a_non_finite_gaussian_is_named(measured):
    """With attribute, count, and the index of the first one."""
    cloud, camera = (
        random_cloud(300, seed=6).to(torch.float32),
        cameras(1, 8, 8, dtype=torch.float32),
    )
    for name in NAMES:
        corrupted = Cloud(*(x.clone() for x in cloud))
        getattr(corrupted, name)[[7, 9]] = math.nan
        count = getattr(corrupted, name)[[7, 9]].numel()
        with pytest.raises(UserError, match=rf"{name} holds {count} .*\(7") as caught:
            rasterize(*corrupted, *camera, 8, 8, non_finite="error")
        assert "nan" in str(caught.value)
    measured("error: named with count and index")


@row(
    "A1",
    "int32 overflow",
    bar="600 k over all of 8192 x 8192: the exact memory in a named error, none allocated",
)
@pytest.mark.slow  # counts 3.9e10 pairs
@pytest.mark.skipif("cpu" not in BACKENDS, reason="the kernel isn't built")
def test_more_tile_intersections_than_32_bits_count(measured):
    """The kernel's tiles, 32 x 32 pixels with AVX-512 and 32 x 16 without, make 3.9e10 pairs or
    more, beyond any machine's memory. Without a backward pass each pair takes 12 bytes: the
    Gaussian, its slot, and its largest weight.
    """
    n, height = 600_000, 32 if Path(cpu.library()._name).stem.endswith("v4") else 16
    cloud = Cloud(*(x.expand(n, *x.shape[1:]) for x in one_gaussian(scale=1e4).to(torch.float32)))
    with pytest.raises(UserError, match=r"cover so many tiles .*GiB") as caught, torch.no_grad():
        rasterize(
            *cloud, *front_camera(8192, 8192, 5000.0, torch.float32), 8192, 8192, backend="cpu"
        )
    needed = float(str(caught.value).split("needs ")[1].split(" GiB")[0])
    measured(
        needed / round(n * (8192 // 32) * (8192 // height) * 12 / 2**30, 1),
        "of the true size",
        what="count",
        at_most=1.0001,
        at_least=0.9999,
    )


# ---- extreme clouds ------------------------------------------------------------------------------


@row("A1", "NaN/Inf inputs")
@each_backend
def test_extreme_clouds_give_finite_images_and_gradients(backend, measured):
    drawn = 0
    for seed in range(20):
        cloud = extreme_cloud(seed, 50)
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
    measured(0, f"of {drawn} extreme", what="not finite")
