"""A1, backward: gradients at the limits, equal bits for any thread count, and artefacts of sorting
by depth.
"""

import functools
import itertools

import pytest
import torch

from tests.helpers.splatting_draws import draw
from tests.helpers.splatting_scenes import (
    NAMES,
    NO_CUTOFFS,
    Cloud,
    cameras,
    cotangents,
    equal,
    error,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
    run,
)
from tests.stability.backends import BACKENDS, each_backend
from tests.stability.rows import row
from tests.stability.scenes import clamped_alpha, finite
from threestudio_gaussiandreamer.splatting import tiles

EXACT = ["torch", "reference"]  # those that support float64


QUICK = [name for name in BACKENDS if name != "reference"]


THREADED = [name for name in QUICK if name != "cuda"]  # those that use torch's threads


# ---- the Jacobian's clamp ------------------------------------------------------------------------


@row("A1", "Edge of image, huge Jacobian", bar="float64: rel <= 1e-6; float32: rel <= 1e-4")
@each_backend
def test_gradients_at_the_clamp(backend, measured):
    """1e-6 holds in float64. In float32 each of about twenty operations rounds by 6e-8, and off the
    image the exponent is a difference of terms hundreds of times larger than itself: 20 x 6e-8 x
    100 is about 1e-4.

    At 1.3 times the limit there is a kink, where both one-sided slopes are valid; there the
    gradient only has to be finite.
    """
    width, focal, z = 16, 20.0, 1.5
    camera, weights = (
        front_camera(width, width, focal),
        torch.randn(width, width, generator=torch.Generator().manual_seed(0)).double(),
    )
    for limits, scale in itertools.product(
        (0.99, 1.0, 1.29, 1.3, 1.31, 5.0, 50.0), (0.01, 0.1, 1.0)
    ):
        x = limits * 0.5 * width / focal * z
        scales = (
            scale * (1 + x),
            scale,
            2 * scale,
        )  # long enough to reach back into the image from anywhere
        cloud = one_gaussian((x, 0.1, z), scales, 0.8)
        mean, spread = (leaf[0].clone().requires_grad_() for leaf in (cloud.means, cloud.scales))
        (clamped_alpha(mean, spread, width, focal, 0.8) * weights).sum().backward()
        cloud = cloud.to(torch.float32 if backend not in EXACT else torch.float64).leaves()
        dtype = cloud.means.dtype
        out = rasterize(
            *cloud, *(c.to(dtype) for c in camera), width, width, backend=backend, **NO_CUTOFFS
        )
        (out.alpha[0, ..., 0] * weights.to(dtype)).sum().backward()
        assert cloud.means.grad.isfinite().all() and cloud.scales.grad.isfinite().all()
        if limits != 1.3 and mean.grad.abs().max() > 1e-6:
            bound = 1e-6 if backend in EXACT else 1e-4
            what = "float64" if backend in EXACT else "float32"
            measured(
                max(
                    error(cloud.means.grad[0], mean.grad), error(cloud.scales.grad[0], spread.grad)
                ),
                what=what,
                at_most=bound,
            )


@functools.cache
def needles(antialias: bool):
    """Return every multiset of three scales in five rotations, which cover all orders of the axes,
    with their float64 gradients.
    """
    steps, g = (1e-8, 1e-4, 1e-2, 1.0, 1e2, 1e4), torch.Generator().manual_seed(2)
    quats = torch.randn(5, 4, generator=g).double()
    found = []
    for scales, quat in itertools.product(itertools.combinations_with_replacement(steps, 3), quats):
        cloud = (
            one_gaussian((0.1, -0.2, 2.0), scales, 0.8)
            ._replace(quats=quat[None])
            .to(torch.float32)
            .to(torch.float64)
        )
        truth = run(
            cloud,
            *front_camera(16, 16, 20.0),
            16,
            16,
            backend="reference",
            antialias=antialias,
            **NO_CUTOFFS,
        )
        found.append((cloud, truth.grads))
    return found


@pytest.mark.slow
@row(
    "A1",
    "Needle, disc, scale 1e-8..1e4",
    bar="finite; gradients rel L2 <= 1e-3 per attribute, where it is > 1e-6 of the largest",
)
@each_backend
@pytest.mark.parametrize("antialias", [False, True])
def test_gradients_of_needles_and_discs(backend, antialias, measured):
    """Per element the bar cannot be met: an element at 1e-6 of the largest is a sum of terms as
    large as the largest, each rounded by 6e-8 of itself, so it is uncertain by 6 % in any order of
    summation. Norms of an attribute meet it.
    """
    for cloud, truth in needles(antialias):
        ours = draw(
            backend, cloud, front_camera(16, 16, 20.0), 16, 16, antialias=antialias, **NO_CUTOFFS
        )
        assert finite(ours)
        largest = max(truth[name].norm() for name in NAMES)
        worst = max(
            error(ours.grads[name], truth[name])
            for name in NAMES
            if truth[name].norm() > 1e-6 * largest
        )
        measured(worst, what="gradients", at_most=1e-3)


# ---- caps and thresholds -------------------------------------------------------------------------


@row("A1", "Alpha cap and threshold, gradient discontinuity")
@pytest.mark.parametrize("backend", EXACT)
def test_interior_gradients_are_those_of_finite_differences(backend, measured):
    """Some pixels are capped, some below the threshold; a step of 1e-6 crosses neither limit."""
    cloud, camera = random_cloud(12, seed=3, size=0.3), cameras(1, 12, 12)
    options = {"alpha_max": 0.6, "backend": backend}
    directions = [
        torch.randn(x.shape, generator=torch.Generator().manual_seed(i)).double()
        for i, x in enumerate(cloud)
    ]
    exact = run(cloud, *camera, 12, 12, **options)
    slope = sum((exact.grads[name] * d).sum() for name, d in zip(NAMES, directions, strict=True))

    def loss(step: float) -> torch.Tensor:
        moved = Cloud(*(x + step * d for x, d in zip(cloud, directions, strict=True)))
        out = rasterize(*moved, *camera, 12, 12, **options)
        return sum(
            (x * g).sum()
            for x, g in zip((out.image, out.alpha, out.depth), cotangents(out), strict=True)
        )

    here, sides = loss(0.0), {side: loss(side * 1e-6) for side in (-1, 1)}
    assert (exact.out.alpha > 0.6).any() and abs(
        sides[1] - 2 * here + sides[-1]
    ) < 1e-6  # nothing jumped on either side
    measured(abs((sides[1] - sides[-1]) / 2e-6 / slope - 1), what="interior", at_most=1e-5)


@row("A1", "Alpha cap and threshold, gradient discontinuity")
@pytest.mark.parametrize("backend", QUICK)
def test_few_pixels_cross_the_threshold(backend, measured):
    """3000 faint Gaussians move by 1e-4 pixels, ten times; a pixel that crosses the threshold
    changes by more than half of alpha_min.
    """
    cloud, (viewmats, Ks) = random_cloud(3000, seed=5, size=0.03), cameras(1, 48, 48)
    cloud = cloud._replace(
        colors=torch.ones(3000, 1).double(), opacities=0.01 * cloud.opacities
    ).to(torch.float32)
    pictures = []
    for frame in range(11):
        moved = Ks.clone()
        moved[0, 0, 2] += 1e-4 * frame
        with torch.no_grad():
            pictures.append(
                rasterize(*cloud, viewmats.float(), moved.float(), 48, 48, backend=backend).image
            )
    flips = torch.stack(
        [(b - a).abs() > 0.5 / 1024 for a, b in zip(pictures, pictures[1:], strict=False)]
    )
    assert flips.any()
    measured(flips.float().mean() * 100, "% of pixels", what="flips", at_most=0.1)


@row("A1", "Alpha cap and threshold, gradient discontinuity")
@each_backend
def test_the_jump_at_the_threshold_is_alpha_min(backend, measured):
    """A Gaussian moves away from a pixel until its alpha drops from the smallest one to zero, found
    by bisection to the last float.
    """

    def alpha(x: float) -> float:
        cloud, camera = (
            one_gaussian((x, 0.0, 2.0), 0.3, 0.8).to(torch.float32),
            front_camera(1, 1, 20.0, torch.float32),
        )
        return rasterize(*cloud, *camera, 1, 1, backend=backend).alpha.item()

    low, high = 0.0, 3.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if alpha(middle) > 0 else (low, middle)
    assert alpha(high) == 0
    measured(alpha(low) * 1024, "alpha_min", what="jump", at_most=1 + 1e-3)


# ---- deep stacks ---------------------------------------------------------------------------------


@row("A1", "Thousands overlapping one pixel")
@each_backend
@pytest.mark.parametrize("faint", [False, True])
def test_ten_thousand_on_one_pixel(backend, faint, measured):
    g = torch.Generator().manual_seed(5)
    means = torch.cat(
        [0.05 * torch.randn(10_000, 2, generator=g), 2 + torch.rand(10_000, 1, generator=g)], 1
    ).double()
    opacities = (
        torch.full((10_000,), 0.002).double()
        if faint
        else 0.01 + 0.89 * torch.rand(10_000, generator=g).double()
    )
    stack = (
        random_cloud(10_000, seed=5)
        ._replace(means=means, opacities=opacities)
        .to(torch.float32)
        .to(torch.float64)
    )
    camera = front_camera(3, 3, 4.0)
    truth, ours = run(stack, *camera, 3, 3, backend="torch"), draw(backend, stack, camera, 3, 3)
    measured(
        max(error(ours.grads[name], truth.grads[name]) for name in NAMES if name != "quats"),
        what="gradients",
        at_most=1e-4,
    )


# ---- the whole gradient --------------------------------------------------------------------------


@row("A1", "Gradient check")
@pytest.mark.parametrize("backend", EXACT)
def test_gradcheck(backend, measured):
    """20 clouds of 1 to 30 Gaussians; attributes, background and cameras at once, along random
    directions, of image, alpha and depth.
    """
    for seed in range(20):
        n = 1 + seed * 29 // 19
        cloud, (viewmats, Ks) = random_cloud(n, seed=seed, size=0.3), cameras(2, 6, 5)
        background = torch.rand(
            3, generator=torch.Generator().manual_seed(seed), dtype=torch.float64
        ).requires_grad_()
        options = {"antialias": bool(seed % 2), "backend": backend, "alpha_min": 0.0, "stop": 0.0}

        def f(*inputs, Ks=Ks, options=options):
            out = rasterize(*inputs[:6], Ks, 6, 5, background=inputs[6], **options)
            return out.image, out.alpha, out.depth

        inputs = (*cloud.leaves(), viewmats.requires_grad_(), background)
        assert torch.autograd.gradcheck(f, inputs, eps=1e-6, atol=1e-7, rtol=1e-5, fast_mode=True)
    measured("20 of 20 clouds")


@row("A1", "Gradient check")
@each_backend
@pytest.mark.parametrize("preset", ["fast", "balanced"])
def test_float32_gradients_with_the_cutoffs_on(backend, preset, measured):
    """All rows count, also those that a threshold treats differently in the other precision."""
    cloud, camera, background = (
        random_cloud(400, seed=4, size=0.1).to(torch.float32).to(torch.float64),
        cameras(2, 40, 30),
        torch.rand(3),
    )
    truth = run(
        cloud, *camera, 40, 30, background, camera_gradient=True, backend="torch", preset=preset
    )
    ours = draw(backend, cloud, camera, 40, 30, background, camera_gradient=True, preset=preset)
    for name, grad in truth.grads.items():
        cosine = torch.cosine_similarity(ours.grads[name].double().flatten(), grad.flatten(), 0)
        measured(1 - cosine, what="1 - cos", at_most=1e-5)
        measured(error(ours.grads[name], grad), what="rel L2", at_most=1e-4)


@row("A1", "Determinism of reductions")
@pytest.mark.parametrize("backend", THREADED)
def test_the_same_bits_for_any_number_of_threads(backend, measured):
    """Forward, backward and an optimiser step, 100 times (10 in plain torch); ten runs with 1, 2, 4
    and 8 threads.
    """
    target = torch.rand(1, 20, 40, 3, generator=torch.Generator().manual_seed(0))
    camera, threads, results = cameras(1, 40, 20, dtype=torch.float32), torch.get_num_threads(), []
    try:
        for count in (1, 2, 4, 8, 1, 2, 4, 8, 1, 2):
            torch.set_num_threads(count)
            leaves = random_cloud(300, seed=1, size=0.06).to(torch.float32).leaves()
            optimizer = torch.optim.Adam(leaves, lr=1e-3)
            for _ in range(100 if backend == "cpu" else 10):
                optimizer.zero_grad()
                (
                    rasterize(*leaves, *camera, 40, 20, backend=backend).image - target
                ).square().sum().backward()
                optimizer.step()
            results.append([leaf.detach().clone() for leaf in leaves])
    finally:
        torch.set_num_threads(threads)
    assert all(
        torch.equal(a, b) for other in results[1:] for a, b in zip(results[0], other, strict=True)
    )
    measured("10 runs bit-identical")


@row("A1", "Coincident depths")
@pytest.mark.parametrize("backend", THREADED)
def test_equal_depths_for_any_number_of_threads(backend, measured):
    flat, threads, results = random_cloud(2000, seed=9, size=0.03), torch.get_num_threads(), []
    flat.means[:, 2] = 2.0
    try:
        for count in (1, 2, 4, 8):
            torch.set_num_threads(count)
            results.append(draw(backend, flat, front_camera(70, 50, 40.0), 70, 50))
    finally:
        torch.set_num_threads(threads)
    assert all(equal(results[0], other) for other in results[1:])
    measured("same bits, 1/2/4/8 threads")


@row("A1", "int32 overflow")
def test_tile_lists_in_torch_are_made_in_parts(measured):
    """600 000 splats over all of 1024 x 1024: 9.8e9 pairs with 8-pixel tiles, counted in 64 bits
    and never listed at once.
    """
    n, grid = 600_000, tiles.make_grid(1, 1024, 1024)
    whole = torch.tensor([[0], [0], [grid.columns], [grid.rows]]).expand(4, n)
    bounds = tiles.Bounds(torch.empty(6, 0), whole, torch.zeros(n, dtype=torch.long))
    parts = tiles.slices(bounds)
    assert [first for first, _ in parts] == [0, *(last for _, last in parts[:-1])] and parts[-1][
        1
    ] == n
    largest = max(last - first for first, last in parts) * grid.tiles
    assert sum((last - first) * grid.tiles for first, last in parts) == n * 128 * 128 > 2**32
    measured(
        largest / 2**20,
        "Mi pairs",
        what="largest part",
        at_most=(tiles.CANDIDATES_PER_SLICE + grid.tiles) / 2**20,
    )
