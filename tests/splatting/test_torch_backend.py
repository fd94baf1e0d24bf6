"""The tiled torch backend against the specification: equal values in bounded memory."""

import torch
from hypothesis import given
from hypothesis import strategies as st

from tests.helpers.splatting_contract import each_options
from tests.helpers.splatting_scenes import (
    EXTREMES,
    NO_CUTOFFS,
    Cloud,
    cameras,
    error,
    extreme_cloud,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
    repeatable,
    run,
)
from threestudio_gaussiandreamer.core.devices import torch_threads
from threestudio_gaussiandreamer.splatting import torch_backend

# float64 against float64: the same formula in another order, so rounding only; 1e-9 leaves room for
# sums of 1e5 terms.
ROUNDING = 1e-9


def compare(cloud, camera, width, height, **options):
    ours, truth = (
        run(cloud, *camera, width, height, camera_gradient=True, backend=b, **options)
        for b in ("torch", "reference")
    )
    for name in ("image", "alpha", "depth", "means2d", "contribution"):
        assert error(getattr(ours.out, name), getattr(truth.out, name)) < ROUNDING, name
    assert torch.equal(ours.out.radii, truth.out.radii)
    for name, grad in truth.grads.items():
        # Absolute where nothing is left but rounding, relative elsewhere.
        difference = ours.grads[name] - grad
        assert error(ours.grads[name], grad) < ROUNDING or difference.abs().max() < 1e-12, name
    if options.get("absgrad"):
        assert error(ours.out.means2d.absgrad, truth.out.means2d.absgrad) < ROUNDING
    return ours, truth


@each_options
def test_options(options):
    compare(random_cloud(150, seed=1, size=0.2), cameras(2, 22, 18), 22, 18, **options)


@repeatable
@given(
    st.integers(0, 10**6),
    st.integers(0, 80),
    st.floats(1e-3, 2.0),
    st.floats(0, 3),
    st.tuples(st.integers(1, 40), st.integers(1, 24)),
)
def test_random_clouds(seed, n, size, stretch, shape):
    """With one to five channels, of all views or of each."""
    views, channels, g = 1 + seed % 3, 1 + seed % 5, torch.Generator().manual_seed(seed)
    cloud = random_cloud(n, seed, channels, size, stretch)
    if seed % 2:
        cloud = cloud._replace(colors=torch.rand(views, n, channels, generator=g).double())
    compare(cloud, cameras(views, *shape), *shape, absgrad=True)


WITH_BRIGHT_COLORS = EXTREMES | {"colors": [*EXTREMES["colors"], 1e3]}


@repeatable
@given(seed=st.integers(0, 10**6), n=st.integers(1, 60), antialias=st.booleans())
def test_extreme_clouds(seed, n, antialias):
    """Equal in float64, finite in float32."""
    cloud, camera = extreme_cloud(seed, n, WITH_BRIGHT_COLORS), cameras(2, 19, 13)
    options = {"antialias": antialias}
    both = [run(cloud, *camera, 19, 13, backend=b, **options) for b in ("torch", "reference")]
    for ours, truth in zip(both[0].out, both[1].out, strict=True):
        assert torch.allclose(ours, truth, rtol=1e-7, atol=1e-9)
    for name, truth in both[1].grads.items():
        atol = 1e-7 * truth.abs().max().item()
        assert torch.allclose(both[0].grads[name], truth, rtol=1e-6, atol=atol), name
    single = run(cloud.to(torch.float32), *camera, 19, 13, backend="torch", **options)
    assert all(x.isfinite().all() for x in (*single.out, *single.grads.values()))


def test_gradients_behind_an_alpha_of_one_are_finite_and_add_up():
    """1 / (1 - alpha) is infinite there; what is behind is invisible, so its share is zero."""
    three = Cloud(*(x.repeat(3, *[1] * (x.dim() - 1)) for x in one_gaussian(opacity=1.0)))
    view = *front_camera(9, 9, 20.0), 9, 9
    result = run(three.to(torch.float32), *view, backend="torch", **NO_CUTOFFS)
    assert result.out.alpha.max() == 1
    assert all(grad.isfinite().all() and grad.abs().max() < 1e3 for grad in result.grads.values())
    out = rasterize(*random_cloud(30).leaves(), *cameras(1, 12, 12), 12, 12, backend="torch")
    out.image.sum().backward(retain_graph=True)
    once = out.means2d.grad.clone()
    out.image.sum().backward()
    assert torch.allclose(out.means2d.grad, 2 * once)


def test_small_budgets_change_nothing(monkeypatch, recorded):
    """Many slices, tests, blocks, steps and parts, as only large scenes take."""
    cloud, camera = random_cloud(60, seed=7, size=0.3), cameras(2, 37, 29)
    splits = recorded(torch_backend, "slices")
    monkeypatch.setattr(torch_backend, "PROJECTED_AT_ONCE", 30)
    monkeypatch.setattr(torch_backend, "CANDIDATES_PER_SLICE", 100)
    monkeypatch.setattr(torch_backend, "CANDIDATES_PER_TEST", 37)
    monkeypatch.setattr(torch_backend, "SPLATS_PER_STEP", 4)
    monkeypatch.setattr(torch_backend, "ELEMENTS_PER_BLOCK", 3 * 4 * 64)
    compare(cloud, camera, 37, 29, absgrad=True)
    compare(cloud._replace(opacities=torch.full((60,), 0.99).double()), camera, 37, 29)
    assert min(len(found) for _, found in splits) > torch_backend.KEPT_SLICES


def test_blocks_and_saved_tensors_are_bounded(monkeypatch, recorded):
    """No tensor of the size pixels x splats is kept for the backward pass."""
    cloud, camera = random_cloud(400, seed=8, size=1.0), cameras(1, 64, 64)
    saved, blocks = [], recorded(torch_backend, "_block")
    monkeypatch.setattr(torch_backend, "ELEMENTS_PER_BLOCK", 2**14)
    hooks = (lambda x: saved.append(x.numel()) or x), (lambda x: x)
    with torch.autograd.graph.saved_tensors_hooks(*hooks):
        out = rasterize(*cloud.leaves(), *camera, 64, 64, backend="torch")
    out.image.sum().backward()
    sizes = [len(args[2]) * args[4] * 64 for args, _ in blocks]
    assert max(sizes) <= 2**14 and sum(sizes) > 20 * max(sizes)
    # Every one of these Gaussians covers most of 4096 pixels: keeping any (pixel, splat) tensor
    # would take over a million.
    assert sum(saved) < 400_000


def test_the_number_of_threads_changes_no_bit_of_a_single_tile():
    """Whose matrix products the threads would otherwise share."""
    cloud, camera = random_cloud(1200, seed=10, size=0.05).to(torch.float32), cameras(1, 8, 8)
    results = []
    for count in (1, 2, 3):
        with torch_threads(count):
            results.append(run(cloud, *camera, 8, 8, backend="torch"))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0].out, other.out, strict=True))
        assert all(torch.equal(grad, other.grads[name]) for name, grad in results[0].grads.items())
