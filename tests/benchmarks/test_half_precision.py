import pytest
import torch

from benchmarks.markdown import write
from benchmarks.splatting import half_precision
from benchmarks.splatting.bench_scenes import make_scene
from benchmarks.splatting.half_precision import Pairs, blended, errors, subtracted
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

CAP = 0.25


def random_pairs():
    """Return pairs of which some alphas are capped, a cotangent, and image and gradient by
    autograd.
    """
    rng = torch.Generator().manual_seed(0)
    gauss = torch.rand(40, 6, generator=rng).double()
    features, cotangent = (torch.rand(n, 3, generator=rng).double() for n in (40, 6))
    opacities = torch.full((40,), 0.3, dtype=torch.float64, requires_grad=True)
    alphas = (opacities[:, None] * gauss).clamp(max=CAP)
    before = torch.cat([torch.ones(1, 6).double(), (1 - alphas[:-1]).cumprod(0)])
    image = torch.einsum("mp,mc->pc", alphas * before, features)
    image.backward(cotangent)
    slopes = torch.where(alphas < CAP, gauss, 0)
    assert (slopes == 0).any()
    return Pairs(alphas.detach(), slopes, features), cotangent, image.detach(), opacities.grad


def test_both_backward_passes_are_that_of_autograd():
    pairs, cotangent, image, gradient = random_pairs()
    found, back_to_front = blended(pairs, cotangent, torch.float64)
    torch.testing.assert_close(found, image)
    torch.testing.assert_close(back_to_front, gradient)
    front_to_back = subtracted(pairs, found, cotangent, torch.float64)
    torch.testing.assert_close(front_to_back, gradient)


def test_coarser_sums_are_worse_and_subtraction_is_worse_than_sums_back_to_front():
    pairs, cotangent, image, gradient = random_pairs()
    found = []
    for dtype in (torch.float32, torch.float16, torch.bfloat16):
        rounded, back_to_front, front_to_back = half_precision.rounded(pairs, cotangent, dtype)
        gradients = torch.stack([back_to_front, front_to_back])
        found.append(
            torch.cat([(gradients - gradient).norm(dim=1), (rounded - image).norm()[None]])
        )
    assert (found[0] < found[1] / 100).all() and (found[1] < found[2] / 2).all()
    assert all(error[0] < error[1] for error in found)


@pytest.mark.skipif(bool(cpu.unavailable()), reason="the kernel isn't built")
def test_a_preset_is_drawn_at_the_same_pixels(monkeypatch):
    """The kernel's gradients belong to the same Gaussians as the exact ones."""
    monkeypatch.setattr(half_precision, "SIZE", 32)
    scene = make_scene(300)
    pixels, cotangent = torch.arange(0, 1024, 7), torch.rand(147, 3).double()
    pairs, ids = half_precision.pairs_of(scene, pixels)
    exact = blended(pairs, cotangent, torch.float64)
    relative = []
    for preset in half_precision.PRESETS:
        image, gradient = half_precision.drawn(scene, pixels, cotangent, preset)
        row = errors(image, [gradient[ids], None], *exact)
        assert row["subtracted"] == ""
        relative.append((-float(row["psnr"]), float(row["gradient"])))
    assert relative == sorted(relative, reverse=True) and relative[-1][1] < 1e-2


def test_the_table_has_formats_and_presets(tmp_path, monkeypatch):
    monkeypatch.setattr(half_precision, "RESULTS", tmp_path / "half_precision.csv")
    names = (*half_precision.FORMATS, *half_precision.PRESETS)
    psnr = dict(zip(names, (90, 60, 50, 55, 60, 80), strict=True))
    rows = [
        {"sums": sums, "scene": scene, "psnr": db, "gradient": gradient, "subtracted": rest}
        for sums, db in psnr.items()
        for scene, gradient in (("trained", db / 1e4), ("fog", "0.03"))
        for rest in ([""] if sums in half_precision.PRESETS else ["0.007"])
    ]
    write(half_precision.RESULTS, half_precision.COLUMNS, rows)
    first, second = half_precision.table().split("\n\n")
    found = "6.0e-03, at most 3.0e-02 | 7.0e-03, at most 7.0e-03"
    assert first.splitlines()[3] == f"| float16 | 60.0 | 60.0 | {found} |"
    assert first.splitlines()[5].startswith("| preset `fast`, ")
    assert first.endswith("at most 3.0e-02 |  |")
    assert second.splitlines()[2:] == [
        "| float16, image | 2 | 0 | 0 |",
        "| float16, gradient, back to front | 0 | 0 | 1 |",
        "| float16, gradient, by subtraction | 1 | 1 | 2 |",
        "| bfloat16, image | 0 | 0 | 0 |",
        "| bfloat16, gradient, back to front | 1 | 1 | 1 |",
        "| bfloat16, gradient, by subtraction | 1 | 1 | 2 |",
    ]
