"""Internals of the torch backend: tiles, blocks, threads."""

import pytest
import torch

from tests.helpers.splatting_scenes import (
    Cloud,
    cameras,
    front_camera,
    one_gaussian,
    random_cloud,
    rasterize,
    require_backward_twice_adds_up,
    run,
    scene_of,
)
from tests.splatting.torch_backend_cases import compare
from threestudio_gaussiandreamer.core.devices import torch_threads
from threestudio_gaussiandreamer.splatting import tiles, torch_backend
from threestudio_gaussiandreamer.splatting.options import RasterizeOptions
from threestudio_gaussiandreamer.splatting.projection import project

# ---- how it works --------------------------------------------------------------------------------


def test_small_budgets_change_nothing(monkeypatch):
    """Many slices, tests, blocks, steps and parts of the projection: code paths that only large
    scenes take.
    """
    cloud, camera = random_cloud(120, seed=7, size=0.3), cameras(2, 37, 29)
    splits = []
    monkeypatch.setattr(torch_backend, "PROJECTED_AT_ONCE", 50)
    monkeypatch.setattr(tiles, "CANDIDATES_PER_SLICE", 200)
    monkeypatch.setattr(tiles, "CANDIDATES_PER_TEST", 37)
    monkeypatch.setattr(torch_backend, "SPLATS_PER_STEP", 4)
    monkeypatch.setattr(torch_backend, "ELEMENTS_PER_BLOCK", 3 * 4 * 64)
    original = tiles.slices
    monkeypatch.setattr(
        torch_backend, "slices", lambda *a: splits.append(original(*a)) or splits[-1]
    )
    compare(cloud, camera, 37, 29, absgrad=True)
    compare(cloud._replace(opacities=torch.full((120,), 0.99).double()), camera, 37, 29)
    assert min(map(len, splits)) > torch_backend.KEPT_SLICES


def test_blocks_and_saved_tensors_are_bounded(monkeypatch):
    """No tensor of the size pixels x splats is kept for backward, and no block exceeds
    its budget.
    """
    cloud, camera = random_cloud(400, seed=8, size=1.0), cameras(1, 64, 64)
    sizes, saved = [], []
    original = torch_backend._block
    monkeypatch.setattr(torch_backend, "ELEMENTS_PER_BLOCK", 2**14)
    monkeypatch.setattr(
        torch_backend, "_block", lambda *a: sizes.append(len(a[2]) * a[4] * 64) or original(*a)
    )
    leaves = cloud.leaves()
    with torch.autograd.graph.saved_tensors_hooks(
        lambda x: saved.append(x.numel()) or x, lambda x: x
    ):
        out = rasterize(*leaves, *camera, 64, 64, backend="torch")
    out.image.sum().backward()
    assert max(sizes) <= 2**14 and sum(sizes) > 20 * max(sizes)
    # Every one of these Gaussians covers most of 4096 pixels: keeping any (pixel, splat) tensor
    # would take over a million.
    assert sum(saved) < 400_000


def test_finished_tiles_are_skipped(monkeypatch):
    """3000 nearly opaque splats on every pixel: T < 1e-4 behind the second, so one step suffices in
    both passes.
    """
    cloud = Cloud(
        *(x.repeat(3000, *[1] * (x.dim() - 1)) for x in one_gaussian(scale=10.0, opacity=0.998))
    )
    steps, original = [], torch_backend._block
    monkeypatch.setattr(torch_backend, "_block", lambda *a: steps.append(a[3]) or original(*a))
    run(cloud, *front_camera(16, 16, 4.0), 16, 16, backend="torch")
    assert steps == [0, 0]


@pytest.mark.parametrize("stretch", [0.3, 2.0])
def test_tile_lists_are_complete_and_tight(stretch):
    """Brute force over all pixels: each tile lists every splat that reaches alpha_min in it, in
    depth order, and few others.
    """
    width, height, options = 40, 32, RasterizeOptions()
    cloud, (viewmats, Ks) = (
        random_cloud(300, seed=9, size=0.05, stretch=stretch),
        cameras(1, width, height),
    )
    splats = project(scene_of(cloud, viewmats, Ks, width, height), options)
    order = splats.depths[0].argsort()[splats.visible[0][splats.depths[0].argsort()]]
    means2d, conics, opacities, _, extents = (x[0, order] for x in splats[:5])
    grid = tiles.make_grid(1, width, height)
    bounds = tiles.bound(
        means2d, conics, opacities, extents, torch.zeros_like(order), grid, options.alpha_min
    )
    lists = tiles.list_splats(bounds, 0, len(order), torch.ones(grid.tiles, dtype=torch.bool), grid)

    y, x = torch.meshgrid(torch.arange(height) + 0.5, torch.arange(width) + 0.5, indexing="ij")
    dx, dy = x - means2d[:, 0, None, None], y - means2d[:, 1, None, None]
    a, k, c = conics[:, :, None, None].unbind(1)
    reached = (
        opacities[:, None, None] * torch.exp(-0.5 * (a * (dx - k * dy) ** 2 + c * dy**2))
        >= options.alpha_min
    )
    reached = reached.reshape(len(order), height // 8, 8, width // 8, 8).any(4).any(2).flatten(1)
    listed = torch.zeros_like(reached)
    for tile, start, count in zip(lists.tiles, lists.starts, lists.counts, strict=True):
        members = lists.splats[start : start + count].long()
        assert (members.diff() > 0).all()
        listed[members, tile] = True
    assert (listed | ~reached).all()
    assert (lists.counts.diff() <= 0).all()
    # The test is exact for the box around a tile's pixel centres; a thin splat may still slip
    # between the centres.
    assert listed.sum() < 1.1 * reached.sum()


@pytest.mark.parametrize("width, height", [(96, 80), (8, 8)])
def test_the_number_of_threads_changes_no_bit(width, height):
    """Also with a single tile, whose matrix products the threads would otherwise share."""
    cloud, camera = (
        random_cloud(3000, seed=10, size=0.05).to(torch.float32),
        cameras(2 if width > 8 else 1, width, height),
    )
    results = []
    for count in (1, 2, 3):
        with torch_threads(count):
            results.append(run(cloud, *camera, width, height, backend="torch"))
    for other in results[1:]:
        assert all(torch.equal(a, b) for a, b in zip(results[0].out, other.out, strict=True))
        assert all(torch.equal(grad, other.grads[name]) for name, grad in results[0].grads.items())


def test_backward_twice_adds_up():
    cloud, camera = random_cloud(30, seed=11).leaves(), cameras(1, 12, 12)
    require_backward_twice_adds_up(cloud, camera, "torch", exact=False)
