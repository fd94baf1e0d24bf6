"""The native kernel against the float64 specification, in every build this machine can run: same pictures, same gradients, same bits."""

import math
import pathlib
import shutil
import subprocess
import weakref
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from splatting_scenes import (
    NAMES,
    NO_CUTOFFS,
    Cloud,
    cameras,
    cotangents,
    error,
    front_camera,
    one_gaussian,
    random_cloud,
    run,
    trimmed_error,
)

from threestudio_gaussiandreamer.errors import UserError
from threestudio_gaussiandreamer.splatting import cpu, rasterize

# float32 against float64 without the worst 0.5 % of the rows (thresholds that fall the other way).
SINGLE = 2e-5
repeatable = settings(derandomize=True, deadline=None, max_examples=25, suppress_health_check=list(HealthCheck))
pytestmark = pytest.mark.skipif(cpu.unavailable() is not None, reason=str(cpu.unavailable()))


@pytest.fixture
def force(monkeypatch):
    """A function that makes one build answer."""

    def force(name):
        monkeypatch.setenv("GAUSSIANDREAMER_ISA", name)
        cpu._library.cache_clear()

    yield force
    cpu._library.cache_clear()


@pytest.fixture(params=cpu.usable_builds())
def isa(request, force):
    force(request.param)
    return request.param


def native(cloud, camera, width, height, background=None, **options):
    camera = [x.to(torch.float32) for x in camera]
    return run(Cloud(*(x.to(torch.float32) for x in cloud)), *camera, width, height, background, backend="cpu", **options)


def compare(cloud, camera, width, height, background=None, tolerance=SINGLE, **options):
    """Pictures and gradients, also of the cameras, within float32's rounding of the specification in float64."""
    truth = run(cloud, *camera, width, height, background, camera_gradient=True, backend="reference", **options)
    ours = native(cloud, camera, width, height, background, camera_gradient=True, **options)
    for name in ("image", "alpha", "depth", "means2d", "contribution"):
        assert error(getattr(ours.out, name), getattr(truth.out, name)) < SINGLE, name
    if options.get("alpha_min") != 0:
        assert torch.allclose(ours.out.radii.double(), truth.out.radii, rtol=1e-5)
    for name, grad in truth.grads.items():
        ours_grad = ours.grads[name]
        if name == "means2d":
            ours_grad, grad = ours_grad.transpose(0, 1), grad.transpose(0, 1)
        assert trimmed_error(ours_grad, grad) < tolerance or (ours_grad - grad).abs().max() < 1e-7, name
    if options.get("absgrad"):
        assert error(ours.out.means2d.absgrad, truth.out.means2d.absgrad) < SINGLE
    return ours


@pytest.mark.parametrize("width, height", [(1, 1), (1, 7), (17, 33), (31, 16), (67, 2)])
def test_sizes_that_are_no_multiple_of_a_tile(isa, width, height):
    compare(random_cloud(60, seed=width), cameras(2, width, height), width, height, torch.tensor([0.2, 0.5, 0.9]))


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
        {"near": 2.9, "far": 3.2, "background": torch.tensor([[0.1, 0.2, 0.3], [0.9, 0.8, 0.7]])},
    ],
    ids=str,
)
def test_options(isa, options):
    compare(random_cloud(150, seed=1, size=0.2), cameras(2, 34, 18), 34, 18, **options)


def test_a_few_thousand_gaussians(isa):
    """More than a chunk per tile, early stops, capped alphas; gradients of everything."""
    cloud = random_cloud(3000, seed=4, size=0.06)
    cloud.opacities[:150] = 0.9999
    compare(cloud, cameras(1, 66, 50), 66, 50, torch.tensor([0.2, 0.5, 0.9]), preset="fast")


@pytest.mark.parametrize("channels", [1, 2, 5])
@pytest.mark.parametrize("per_view", [False, True])
def test_channels_shared_or_per_view(channels, per_view):
    cloud = random_cloud(40, seed=2, channels=channels)
    if per_view:
        cloud = cloud._replace(colors=torch.rand(3, 40, channels, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    compare(cloud, cameras(3, 14, 10), 14, 10, torch.rand(channels, generator=torch.Generator().manual_seed(1)))


def test_colors_of_each_view(isa):
    cloud = random_cloud(50, seed=2)._replace(colors=torch.rand(2, 50, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64))
    compare(cloud, cameras(2, 40, 20), 40, 20)


def test_absgrad_of_five_channels_is_exact():
    compare(random_cloud(30, seed=3, channels=5), cameras(1, 14, 10), 14, 10, absgrad=True)


# ---- hostile clouds ------------------------------------------------------------------------------------------------------------

HOSTILE = {
    "means": [0.0, 0.3, -0.7, 3.0, -3.0, 1e4, 1e30, math.nan, math.inf],
    "quats": [0.0, 1.0, -1.0, 1e-20, 1e-40, 1e20, math.nan],
    "scales": [1e-8, 1e-4, 1e-2, 0.3, 1.0, 100.0, 1e4, 0.0, math.inf],
    "opacities": [0.0, 1 / 1024, 0.5, 0.9, 1.0, math.nan],
    "colors": [0.0, 1.0, -2.0, math.nan],
}


def hostile_cloud(seed: int, n: int) -> Cloud:
    """Half of the entries are picked from HOSTILE, the others are ordinary; the second half's means coincide with the first's."""
    g = torch.Generator().manual_seed(seed)
    cloud = random_cloud(n, seed)
    for name, x in zip(NAMES, cloud, strict=True):
        values = torch.tensor(HOSTILE[name], dtype=torch.float64)
        picked = values[torch.randint(len(values), x.shape, generator=g)]
        rare = picked.isfinite() | (torch.rand(x.shape, generator=g) < 0.1)
        x.copy_(torch.where((torch.rand(x.shape, generator=g) < 0.5) & rare, picked, x))
    cloud.means[n // 2 :] = cloud.means[: n - n // 2].clone()
    return cloud


@repeatable
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), antialias=st.booleans())
def test_hostile_clouds(seed, n, antialias):
    """Needles, discs, behind the camera, NaN, infinite, coincident, transparent, opaque: finite, and the picture is right."""
    cloud, camera = hostile_cloud(seed, n), cameras(2, 37, 13)
    ours = native(cloud, camera, 37, 13, antialias=antialias, camera_gradient=True)
    assert all(x.isfinite().all() for x in (*ours.out, *ours.grads.values()))
    with torch.no_grad():
        truth = rasterize(*cloud, *camera, 37, 13, antialias=antialias, backend="reference")
    # One alpha on the other side of alpha_min = 1/1024 moves a pixel by that times the range of colours, 3.
    assert (ours.out.image - truth.image).abs().max() < 3 / 1024
    assert ((ours.out.image - truth.image).abs() > 1e-4).float().mean() < 5e-3


@repeatable
@given(
    seed=st.integers(0, 10**6),
    n=st.integers(0, 80),
    size=st.floats(1e-3, 2.0),
    stretch=st.floats(0, 3),
    width=st.integers(1, 70),
    height=st.integers(1, 40),
)
def test_random_clouds(seed, n, size, stretch, width, height):
    """Any size and shape. Thresholds may fall the other way here and there, so the median error is judged."""
    cloud, camera = random_cloud(n, seed, size=size, stretch=stretch), cameras(1 + seed % 3, width, height)
    ours, truth = native(cloud, camera, width, height), run(cloud, *camera, width, height, backend="reference")
    assert (ours.out.image - truth.out.image).abs().max() < 2 / 1024
    largest = max((grad.abs().max() for grad in truth.grads.values() if grad.numel()), default=0)
    for name in NAMES:
        distance = (ours.grads[name] - truth.grads[name]).abs().flatten()
        assert n == 0 or distance.median() <= SINGLE * largest, name


def test_needles_and_discs(isa):
    """Every combination of scales 1e-8 .. 1e4 and five rotations, one at a time: within 2e-5 of float64 (stability.md A1)."""
    steps = torch.tensor([1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4], dtype=torch.float64)
    scales = torch.cartesian_prod(steps, steps, steps).repeat_interleave(5, 0)
    quats = torch.randn(5, 4, generator=torch.Generator().manual_seed(2)).double().repeat(216, 1)
    one = one_gaussian((0.1, -0.2, 2.0), 1.0, 0.8)
    camera, worst = front_camera(16, 16, 20.0), 0.0
    with torch.no_grad():
        for i in range(0, len(scales), 3):
            cloud = one._replace(scales=scales[i : i + 1], quats=quats[i : i + 1])
            single = [x.to(torch.float32) for x in (*cloud, *camera)]
            alphas = (
                rasterize(*single, 16, 16, alpha_min=1e-5, backend="cpu").alpha,
                rasterize(*cloud, *camera, 16, 16, alpha_min=1e-5, backend="reference").alpha,
            )
            worst = max(worst, (alphas[0] - alphas[1]).abs().max().item())
    assert worst < 2e-5


def test_gradient_of_a_needle(isa):
    """1000 : 1 at an angle. Its covariance's determinant cancels in float32 unless it is factored."""
    cloud = one_gaussian((0.02, -0.03, 2.0), (0.5, 5e-4, 5e-4), 0.7)._replace(
        quats=torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)
    )
    # 1e-3 is the bar of stability.md A1: a needle's edge moves by its length times any error of the angle.
    compare(cloud, front_camera(64, 64, 200.0), 64, 64, tolerance=1e-3, alpha_min=1e-5)


@pytest.mark.parametrize("slope", [0.99, 1.29, 1.31, 5.0])
def test_gradient_beyond_the_edge_of_the_image(isa, slope):
    """Inside and outside of the clamp of the Jacobian, whose gradient keeps its z-term."""
    cloud = one_gaussian((2 * slope * 0.8, 0.1, 2.0), (1.5, 0.8, 0.4), 0.7)._replace(
        quats=torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)
    )
    compare(cloud, front_camera(32, 32, 20.0), 32, 32, alpha_min=1e-6)


def test_ten_thousand_gaussians_on_one_pixel(isa):
    g = torch.Generator().manual_seed(5)
    means = torch.cat([0.05 * torch.randn(10_000, 2, generator=g), 2 + torch.rand(10_000, 1, generator=g)], 1).double()
    for opacities in (0.01 + 0.89 * torch.rand(10_000, generator=g).double(), torch.full((10_000,), 0.002).double()):
        stack, camera = random_cloud(10_000, seed=5)._replace(means=means, opacities=opacities), front_camera(3, 3, 4.0)
        truth, ours = run(stack, *camera, 3, 3, backend="reference"), native(stack, camera, 3, 3)
        assert error(ours.out.image, truth.out.image) < 1e-5
        for name in ("scales", "opacities", "colors", "means"):
            # Sums of up to ten thousand terms in float32; the bar of stability.md A1.
            assert trimmed_error(ours.grads[name], truth.grads[name]) < 1e-4, name


def test_the_gaussian_that_crosses_the_stop_counts(isa):
    cloud = Cloud(*(x.repeat(4, *[1] * (x.dim() - 1)) for x in one_gaussian(scale=10.0)))
    cloud = cloud._replace(opacities=torch.tensor([0.9, 0.905, 0.99, 0.5], dtype=torch.float64))
    ours = native(cloud, front_camera(1, 1, 1.0), 1, 1)
    assert ours.out.alpha.item() == pytest.approx(1 - 0.1 * 0.095 * 0.01, abs=1e-6)
    assert ours.out.contribution[0, 3] == 0


def test_equal_depths_are_drawn_by_index(isa):
    """64 Gaussians in one plane: the first one wins, whatever the permutation."""
    cloud = Cloud(*(x.repeat(64, *[1] * (x.dim() - 1)) for x in one_gaussian(scale=1.0, opacity=0.9)))
    colors = torch.rand(64, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    for seed in range(3):
        order = torch.randperm(64, generator=torch.Generator().manual_seed(seed))
        compare(cloud._replace(colors=colors[order]), front_camera(8, 8, 4.0), 8, 8)


def test_depth_order_is_exact(isa):
    """Depths one float apart, and spread over twenty orders of magnitude."""
    depths = torch.tensor([2.0], dtype=torch.float32).repeat(40)
    for i in range(1, 40):
        depths[i] = torch.nextafter(depths[i - 1], torch.tensor(3.0)) if i < 20 else depths[i - 1] * 3
    means = torch.stack([torch.zeros(40), torch.zeros(40), depths], 1).double()
    order = torch.randperm(40, generator=torch.Generator().manual_seed(0))
    cloud = random_cloud(40, seed=1)._replace(means=means[order], scales=means[order][:, 2:].repeat(1, 3) * 0.2)
    truth, ours = (
        run(c, *(x.to(c.means.dtype) for x in front_camera(4, 4, 3.0)), 4, 4, backend=b)
        for c, b in ((cloud, "reference"), (cloud.to(torch.float32), "cpu"))
    )
    assert error(ours.out.image, truth.out.image) < 1e-5 and error(ours.out.depth, truth.out.depth) < 1e-5


@pytest.mark.parametrize(
    "attribute, value", [("scales", math.inf), ("means", math.nan), ("colors", math.nan), ("quats", -math.inf), ("opacities", math.nan)]
)
def test_a_gaussian_that_is_not_finite_changes_no_bit_of_the_others(isa, attribute, value):
    cloud, camera = random_cloud(300, seed=6), cameras(2, 40, 24)
    poisoned = Cloud(*(x.clone() for x in cloud))
    getattr(poisoned, attribute)[7] = value
    rest = torch.arange(300) != 7
    with_it, without = native(poisoned, camera, 40, 24), native(cloud.pick(rest), camera, 40, 24)
    assert torch.equal(with_it.out.image, without.out.image) and torch.equal(with_it.out.contribution[:, rest], without.out.contribution)
    for name in NAMES:
        assert torch.equal(with_it.grads[name][rest], without.grads[name]) and (with_it.grads[name][7] == 0).all()


def test_quaternions_of_any_length(isa):
    cloud, camera = random_cloud(50, seed=7), cameras(1, 20, 20)
    once = native(cloud, camera, 20, 20)
    for factor in (-1.0, 5.0, 1e-8, 1e18):
        other = native(cloud._replace(quats=cloud.quats * factor), camera, 20, 20)
        assert error(other.out.image, once.out.image) < 1e-6
    none = native(cloud._replace(quats=torch.zeros(50, 4)), camera, 20, 20)
    identity = native(cloud._replace(quats=torch.tensor([1.0, 0, 0, 0]).repeat(50, 1)), camera, 20, 20)
    assert torch.equal(none.out.image, identity.out.image) and (none.grads["quats"] == 0).all()


def test_nothing_to_see_is_the_background_bit_for_bit(isa):
    background = torch.tensor([0.1, 0.2, 0.3])
    for cloud in (random_cloud(0), random_cloud(5)._replace(means=torch.full((5, 3), 100.0).double())):
        for scale in (1, 2):
            result = native(cloud, cameras(2, 10, 8), 10, 8, background, downsample=scale)
            assert torch.equal(result.out.image, background.expand(2, 8 // scale, 10 // scale, 3)) and (result.out.alpha == 0).all()
            assert all(
                (result.grads[name] == 0).all() and result.grads[name].shape == leaf.shape for name, leaf in zip(NAMES, cloud, strict=True)
            )
            assert error(result.grads["background"], cotangents(result.out)[0].sum((0, 1, 2))) < 1e-6


# ---- the same bits -------------------------------------------------------------------------------------------------------------


def equal(a, b) -> bool:
    return all(torch.equal(x, y) for x, y in zip(a.out, b.out, strict=True)) and all(
        torch.equal(grad, b.grads[name]) for name, grad in a.grads.items()
    )


@pytest.mark.parametrize("views", [1, 3])
def test_the_number_of_threads_changes_no_bit(isa, views):
    """Also not when there are more Gaussians than one task takes, or more threads than views; twice each."""
    cloud, camera = random_cloud(9000, seed=10, size=0.03), cameras(views, 150, 90)
    background, threads, results = torch.tensor([0.2, 0.5, 0.9]), torch.get_num_threads(), []
    try:
        for count in (1, 2, 4, 1, 2, 4):
            torch.set_num_threads(count)
            results.append(native(cloud, camera, 150, 90, background, camera_gradient=True, absgrad=True))
    finally:
        torch.set_num_threads(threads)
    assert all(equal(results[0], other) for other in results[1:])


def test_views_do_not_see_each_other(isa):
    cloud, (viewmats, Ks) = random_cloud(400, seed=3), cameras(4, 40, 24)
    batch = native(cloud, (viewmats, Ks), 40, 24).out
    for view in range(4):
        alone = native(cloud, (viewmats[view : view + 1], Ks[view : view + 1]), 40, 24).out
        assert all(torch.equal(ours[view], other[0]) for ours, other in zip(batch, alone, strict=True))


# ---- as a torch function -------------------------------------------------------------------------------------------------------


def test_several_forwards_before_their_backwards():
    """Each graph owns what its backward needs, whatever was drawn in between and in whichever order they run."""
    clouds = [random_cloud(n, seed=n).to(torch.float32) for n in (300, 40, 900)]
    camera = [x.to(torch.float32) for x in cameras(2, 70, 40)]
    alone = [native(cloud, camera, 70, 40) for cloud in clouds]
    leaves = [cloud.leaves() for cloud in clouds]
    outs = [rasterize(*cloud, *camera, 70, 40, backend="cpu") for cloud in leaves]
    for i in (1, 2, 0):
        torch.autograd.backward([outs[i].image, outs[i].alpha, outs[i].depth], cotangents(outs[i]))
    for cloud, expected in zip(leaves, alone, strict=True):
        assert all(torch.equal(leaf.grad, expected.grads[name]) for name, leaf in zip(NAMES, cloud, strict=True))


def test_backward_gives_the_memory_back(monkeypatch):
    """What a backward pass needed goes with the saved tensors, not with the last tensor of the graph."""
    states, as_tensor = weakref.WeakSet(), cpu._State.as_tensor
    monkeypatch.setattr(cpu._State, "as_tensor", lambda self: states.add(self) or as_tensor(self))
    out = rasterize(*random_cloud(30).to(torch.float32).leaves(), *cameras(1, 12, 12, dtype=torch.float32), 12, 12, backend="cpu")
    assert len(states) == 1
    out.image.sum().backward()
    assert len(states) == 0 and out.image.grad_fn is not None


def test_hooks_on_saved_tensors_may_replace_them():
    """As checkpointing and offloading do: what the kernel kept is then made again."""
    cloud, camera = random_cloud(30, seed=13), cameras(1, 40, 12)
    plain = native(cloud, camera, 40, 12)
    with torch.autograd.graph.saved_tensors_hooks(torch.clone, lambda x: x):
        hooked = native(cloud, camera, 40, 12)
    assert equal(plain, hooked)


def test_backward_twice_adds_up():
    cloud, camera = random_cloud(30, seed=11).to(torch.float32).leaves(), [x.to(torch.float32) for x in cameras(1, 12, 12)]
    out = rasterize(*cloud, *camera, 12, 12, backend="cpu", absgrad=True)
    gradients = cotangents(out)
    torch.autograd.backward([out.image, out.alpha, out.depth], gradients, retain_graph=True)
    once = cloud.means.grad.clone(), out.means2d.grad.clone(), out.means2d.absgrad.clone()
    torch.autograd.backward([out.image, out.alpha, out.depth], gradients)
    for first, both in zip(once, (cloud.means.grad, out.means2d.grad, out.means2d.absgrad), strict=True):
        assert torch.equal(2 * first, both)


@pytest.mark.parametrize("names", [("image",), ("alpha",), ("depth",), ("image", "depth")])
def test_pictures_without_a_gradient_count_as_zero(names):
    cloud, camera = random_cloud(50, seed=12).to(torch.float32), [x.to(torch.float32) for x in cameras(1, 40, 12)]
    sparse, full = cloud.leaves(), cloud.leaves()
    out = rasterize(*sparse, *camera, 40, 12, backend="cpu")
    sum(getattr(out, name).square().sum() for name in names).backward()
    out = rasterize(*full, *camera, 40, 12, backend="cpu")
    sum(getattr(out, name).square().sum() * (name in names) for name in ("image", "alpha", "depth")).backward()
    assert all(torch.equal(a.grad, b.grad) for a, b in zip(sparse, full, strict=True) if a.grad is not None)


def test_the_library_is_used_from_several_threads_at_once():
    """Autograd and data loaders have threads of their own."""
    clouds = [random_cloud(200, seed=n) for n in range(4)]
    alone = [native(cloud, cameras(2, 60, 40), 60, 40) for cloud in clouds]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            together = pool.map(lambda cloud: native(cloud, cameras(2, 60, 40), 60, 40), clouds)
            assert all(equal(a, b) for a, b in zip(alone, together, strict=True))


def test_denormals_of_the_process_are_not_flushed(isa):
    native(random_cloud(100), cameras(1, 20, 20), 20, 20)
    assert (torch.tensor(1e-40) * 1).item() > 0 and 5e-324 * 1.0 > 0


def test_more_memory_than_there_is_is_a_named_error():
    """2.6e9 pairs of Gaussian and tile: more than 32 bits count, and more than any machine should try."""
    cloud, camera = (
        random_cloud(40_000).to(torch.float32)._replace(scales=torch.full((40_000, 3), 1e3)),
        cameras(1, 8192, 8192, dtype=torch.float32),
    )
    with pytest.raises(UserError, match="GiB"), torch.no_grad():
        rasterize(*cloud, *camera, 8192, 8192, backend="cpu")


# ---- the library ---------------------------------------------------------------------------------------------------------------


def test_a_build_that_does_not_exist_is_named(force):
    force("v5")
    with pytest.raises(UserError, match="v4"):
        cpu._library()


def test_without_a_library_it_says_what_to_do(monkeypatch, tmp_path):
    monkeypatch.setattr(cpu, "FOLDER", tmp_path)
    cpu._library.cache_clear()
    try:
        assert "compiler" in cpu.unavailable()
    finally:
        cpu._library.cache_clear()


@pytest.mark.skipif(shutil.which("g++") is None, reason="needs g++")
def test_the_formulas_need_no_standard_header_and_work_on_single_floats(tmp_path):
    """The CUDA kernels include the same header, compiled where no standard library is."""
    source = tmp_path / "one.cpp"
    source.write_text(
        '#include "splat_math.h"\nfloat f(splat::Vec3<float> u, splat::Vec3<float> v) { return splat::whiten(u, v, 0.3f).a; }\n'
    )
    folder = pathlib.Path(cpu.__file__).parent / "native"
    subprocess.run(
        ["g++", "-std=c++17", "-nostdinc", "-nostdinc++", "-Wall", "-Werror", "-fsyntax-only", f"-I{folder}", "-c", str(source)], check=True
    )
