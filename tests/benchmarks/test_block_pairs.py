"""Counts of pairs of splats and blocks, against the specification on a small image."""

import torch

from benchmarks.markdown import read
from benchmarks.splatting import block_pairs, pairs
from benchmarks.splatting.bench_scenes import make_scene
from threestudio_gaussiandreamer.splatting import reference
from threestudio_gaussiandreamer.splatting.options import RasterizeOptions
from threestudio_gaussiandreamer.splatting.projection import project
from threestudio_gaussiandreamer.splatting.validation import as_scene, named


def small_case(size=32, stop=0.2):
    """Return two views in which many pixels stop."""
    cloud = make_scene(200)
    options = RasterizeOptions(alpha_min=1 / 255, stop=stop)
    cameras = pairs.stacked(pairs.cameras_around(2, size))
    return pairs.Case("small", cloud._replace(scales=2 * cloud.scales), *cameras, size, options)


def weights_of(case):
    """Return which splats have a weight at each pixel of each view, (B, H * W, M)."""
    scene = as_scene(named(*case.cloud, case.viewmats, case.Ks, None), case.size, case.size)
    splats = project(scene, case.options)
    for view in range(2):
        ordered = reference.sort(splats, case.cloud.colors.expand(2, -1, -1), view)
        x, y = (reference.pixel_centres(case.size, case.size, splats.depths)[:, None]
                - ordered.means2d).unbind(-1)  # fmt: skip
        a, k, c = ordered.conics.unbind(-1)
        alphas = ordered.opacities * torch.exp(-0.5 * (a * (x - k * y) ** 2 + c * y**2))
        alphas = torch.where(alphas >= 1 / 255, alphas.clamp(max=case.options.alpha_max), 0)
        before = torch.cat([torch.ones(len(x), 1), (1 - alphas[:, :-1]).cumprod(1)], 1)
        yield (alphas > 0) & (before >= case.options.stop)


def test_pixels_with_a_weight_are_those_of_the_specification():
    case = small_case()
    expected = sum(int(found.sum()) for found in weights_of(case))
    for width, height in ((4, 4), (4, 2), (1, 1)):
        found, weights = block_pairs.count(case, width, height, 4)
        assert weights == expected
    assert expected <= found  # of single pixels: those of a whole batch
    assert (
        block_pairs.count(small_case(stop=0), 1, 1, 4)[0]
        == block_pairs.count(small_case(stop=0), 1, 1, 4)[1]
    )


def test_pairs_are_those_that_reach_a_block():
    """Blocks of 2 x 2: without a stop, at least those in which a pixel has a weight, and few more,
    whose ellipses pass between the pixel centres.
    """
    case = small_case(stop=0)
    within = sum(
        int(found.view(16, 2, 16, 2, -1).any(3).any(1).sum()) for found in weights_of(case)
    )
    pairs_found, _ = block_pairs.count(case, 2, 2, 4)
    assert within <= pairs_found < 1.05 * within


def test_a_list_ends_with_the_batch_after_which_no_pixel_is_live():
    blocks = torch.tensor([0, 0, 0, 0, 0, 1, 1])
    live = torch.tensor([True, False, False, False, False, True, True])
    assert block_pairs.blended(blocks, live, 4) == 4 + 2
    assert block_pairs.blended(blocks, live, 8) == 5 + 2


def test_the_table_is_of_the_rows(tmp_path, monkeypatch):
    monkeypatch.setattr(block_pairs, "RESULTS", tmp_path / "block_pairs.csv")
    monkeypatch.setattr(block_pairs, "CASES", ("small 32",))
    monkeypatch.setattr(block_pairs, "make_case", lambda name: small_case())
    block_pairs.main()
    first, second = read(block_pairs.RESULTS)
    assert int(first["pairs"]) < int(second["pairs"]) and first["block"] == "4 × 4"
    line = block_pairs.table().splitlines()[2]
    assert line.startswith("| small, 200 Gaussians, 2 × 32² | 4 × 4 (`v4`) | ")
    assert line.endswith(f" | {float(first['pixels']):.1f} of 16 |")
