"""Errors of blending with colour sums of fewer bits: why the kernels keep them in float32.

    python -m benchmarks.splatting.half_precision

At random pixels of the six scenes, 512^2, without cutoffs: transmittances are exact, the sum of the
colours is rounded after each Gaussian, as by a kernel that keeps it in that format. The backward
pass subtracts the sum up to a Gaussian from the whole to get what is behind it, so the rounding
enters the gradients. Writes ``benchmarks/results/half_precision.csv``: PSNR against float64 in dB,
and the relative L2 error of the gradient with respect to the opacities."""

import math
from typing import NamedTuple

import torch
from torch import Tensor

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT
from benchmarks.splatting.bench_scenes import Scene
from benchmarks.splatting.chart_splatting import at_pixels
from benchmarks.splatting.scenes import scenes

RESULTS = ROOT / "benchmarks/results/half_precision.csv"
COLUMNS = ("format", "scene", "psnr", "gradient")
FORMATS = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
SIZE, PIXELS = 512, 512


class Pairs(NamedTuple):
    """Each of M Gaussians, front to back, at each of P pixels."""

    alphas: Tensor
    """(M, P) float64."""
    transmittances: Tensor
    """(M, P): before the Gaussian."""
    features: Tensor
    """(M, 3)."""
    opacities: Tensor
    """(M,)."""


def main() -> None:
    rows = []
    for name, scene in scenes().items():
        pairs = pairs_of(scene)
        cotangent = torch.randn(PIXELS, 3, generator=torch.Generator().manual_seed(0)).double()
        image, gradient = blended(pairs, cotangent, torch.float64)
        for text, dtype in FORMATS.items():
            rounded, other = blended(pairs, cotangent, dtype)
            error = float((rounded - image).square().mean())
            relative = float((other - gradient).norm() / gradient.norm())
            rows.append({"format": text, "scene": name, "psnr": f"{-10 * math.log10(error):.2f}"})
            rows[-1]["gradient"] = f"{relative:.3g}"
            print(rows[-1], flush=True)
    write(RESULTS, COLUMNS, rows)


def pairs_of(scene: Scene) -> Pairs:
    """Evaluate the scene's Gaussians at random pixels, with no cutoff but the cap of alpha."""
    pixels = torch.randperm(SIZE * SIZE, generator=torch.Generator().manual_seed(SIZE))[:PIXELS]
    options, ordered, centres = at_pixels([x.double() for x in scene], SIZE, pixels)
    x, y = (centres - ordered.means2d[:, None]).unbind(-1)
    a, k, c = ordered.conics[:, None].unbind(-1)
    gauss = torch.exp(-0.5 * (a * (x - k * y) ** 2 + c * y**2))
    alphas = (ordered.opacities[:, None] * gauss).clamp(max=options.alpha_max)
    before = (1 - alphas).cumprod(0).roll(1, 0)
    before[0] = 1
    return Pairs(alphas, before, ordered.features[:, :3], ordered.opacities)


def blended(pairs: Pairs, cotangent: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the colours (P, 3), and the gradient of ``cotangent`` with respect to the opacities.

    Args:
        dtype: of the sum of the colours.
    """
    weights = pairs.alphas * pairs.transmittances
    total, sums = torch.zeros_like(cotangent), []
    for weight, feature in zip(weights, pairs.features, strict=True):
        total = (total + weight[:, None] * feature).to(dtype).double()
        sums.append((total * cotangent).sum(1))
    behind = (total * cotangent).sum(1) - torch.stack(sums)
    own = pairs.transmittances * (pairs.features @ cotangent.T)
    to_alphas = own - behind / (1 - pairs.alphas)
    slopes = pairs.alphas / pairs.opacities[:, None]  # the cap's slope of 0 is left out in all
    return total, (to_alphas * slopes).sum(1)


def table() -> str:
    """Return the errors of each format."""
    rows = read(RESULTS)
    names = list(dict.fromkeys(row["scene"] for row in rows))
    cells = {(row["format"], row["scene"]): row for row in rows}
    lines = []
    for text in FORMATS:
        psnr = (f"{float(cells[text, name]['psnr']):.1f}" for name in names)
        lines.append((text, *psnr, f"{float(cells[text, 'trained']['gradient']):.1e}"))
    return markdown(("sum of the colours", *names, "gradient, trained"), lines)


if __name__ == "__main__":
    main()
