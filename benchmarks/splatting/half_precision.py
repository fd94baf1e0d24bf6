"""Errors of blending with sums of fewer bits, beside those of the presets' cutoffs.

    python -m benchmarks.splatting.half_precision

At random pixels of the six scenes, 512^2, without cutoffs: alphas, transmittances and weights are
exact, and each sum is rounded after each Gaussian, as by a kernel that keeps it in that format. In
the forward pass that is the sum of the colours, in the backward pass what lies behind a Gaussian,
which the CPU kernel adds up back to front; the CUDA kernels subtract, front to back, from the whole
sum. The presets are drawn by the CPU kernel at the same pixels. Cotangents have unit variance;
those of a mean over an image are so small that float16 would need a loss scale besides.

Writes ``benchmarks/results/half_precision.csv``: PSNR against float64 in dB, and the relative L2
error of the gradient with respect to the opacities, ``gradient`` of the pass back to front and
``subtracted`` of that front to back."""

import math
from typing import Any, NamedTuple, Optional

import torch
from torch import Tensor

from benchmarks.markdown import markdown, read, write
from benchmarks.quality.runs import ROOT, commit, machine, require_kernel
from benchmarks.splatting.bench_scenes import Scene, make_camera
from benchmarks.splatting.chart_splatting import at_pixels
from benchmarks.splatting.scenes import scenes
from threestudio_gaussiandreamer.splatting import rasterize

RESULTS = ROOT / "benchmarks/results/half_precision.csv"
COLUMNS = ("sums", "scene", "psnr", "gradient", "subtracted", "machine", "commit")
FORMATS = {"float32": torch.float32, "float16": torch.float16, "bfloat16": torch.bfloat16}
PRESETS = ("fast", "balanced", "accurate")
SIZE, PIXELS = 512, 512


class Pairs(NamedTuple):
    """Each of M Gaussians, front to back, at each of P pixels."""

    alphas: Tensor
    """(M, P) float64."""
    slopes: Tensor
    """(M, P): d alpha / d opacity, 0 where alpha is capped."""
    features: Tensor
    """(M, 3)."""

    @property
    def transmittances(self) -> Tensor:
        """Those before each Gaussian, (M, P)."""
        before = (1 - self.alphas).cumprod(0).roll(1, 0)
        before[0] = 1
        return before


def main() -> None:
    require_kernel()
    pixels = torch.randperm(SIZE * SIZE, generator=torch.Generator().manual_seed(SIZE))[:PIXELS]
    cotangent = torch.randn(PIXELS, 3, generator=torch.Generator().manual_seed(0)).double()
    rows: list[dict[str, Any]] = []
    for name, scene in scenes().items():
        pairs, ids = pairs_of(scene, pixels)
        exact = blended(pairs, cotangent, torch.float64)
        found = {text: rounded(pairs, cotangent, dtype) for text, dtype in FORMATS.items()}
        for preset in PRESETS:
            image, gradient = drawn(scene, pixels, cotangent, preset)
            found[preset] = image, gradient[ids], None
        for text, (image, *gradients) in found.items():
            row = {"sums": text, "scene": name} | errors(image, gradients, *exact)
            print(row, flush=True)
            rows.append(row | {"machine": machine(), "commit": commit()})
    write(RESULTS, COLUMNS, rows)


def pairs_of(scene: Scene, pixels: Tensor) -> tuple[Pairs, Tensor]:
    """Evaluate the scene's Gaussians at some pixels, with no cutoff but the cap of alpha; also
    return which Gaussians of the scene they are.
    """
    options, ordered, centres = at_pixels([x.double() for x in scene], SIZE, pixels)
    x, y = (centres - ordered.means2d[:, None]).unbind(-1)
    a, k, c = ordered.conics[:, None].unbind(-1)
    gauss = torch.exp(-0.5 * (a * (x - k * y) ** 2 + c * y**2))
    alphas = ordered.opacities[:, None] * gauss
    slopes = torch.where(alphas < options.alpha_max, gauss, 0)
    pairs = Pairs(alphas.clamp(max=options.alpha_max), slopes, ordered.features[:, :3])
    return pairs, ordered.ids


def rounded(pairs: Pairs, cotangent: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor]:
    """Return the image, and the gradients by the pass back to front and by that front to back."""
    image, gradient = blended(pairs, cotangent, dtype)
    return image, gradient, subtracted(pairs, image, cotangent, dtype)


def blended(pairs: Pairs, cotangent: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Return the colours (P, 3), and the gradient of ``cotangent`` with respect to the opacities,
    for which what lies behind each Gaussian is added up back to front, as by the CPU kernel.

    Args:
        dtype: of the sums.
    """
    weights = pairs.alphas * pairs.transmittances
    image = torch.zeros_like(cotangent)
    for weight, feature in zip(weights, pairs.features, strict=True):
        image = (image + weight[:, None] * feature).to(dtype).double()
    behind, differences = torch.zeros(len(cotangent)).double(), []
    values = pairs.features @ cotangent.T
    for alpha, value in zip(pairs.alphas.flip(0), values.flip(0), strict=True):
        differences.append(value - behind)
        behind = (behind + alpha * differences[-1]).to(dtype).double()
    to_alphas = pairs.transmittances * torch.stack(differences).flip(0)
    return image, (to_alphas * pairs.slopes).sum(1)


def subtracted(pairs: Pairs, image: Tensor, cotangent: Tensor, dtype: torch.dtype) -> Tensor:
    """Return the same gradient, for which the sum behind each Gaussian is what is left of the
    whole after those before it are subtracted, as by the CUDA kernels.

    Args:
        image: the colours that the forward pass has kept.
    """
    weights, values = pairs.alphas * pairs.transmittances, pairs.features @ cotangent.T
    left, behind = (image * cotangent).sum(1).to(dtype).double(), []
    for gain in weights * values:
        left = (left - gain).to(dtype).double()
        behind.append(left)
    to_alphas = pairs.transmittances * values - torch.stack(behind) / (1 - pairs.alphas)
    return (to_alphas * pairs.slopes).sum(1)


def drawn(scene: Scene, pixels: Tensor, cotangent: Tensor, preset: str) -> tuple[Tensor, Tensor]:
    """Return colours and gradient of all opacities as the CPU kernel computes them."""
    viewmat, K = (x[None] for x in make_camera(SIZE))
    opacities = scene.opacities.clone().requires_grad_()
    leaves = scene._replace(opacities=opacities)
    image = rasterize(*leaves, viewmat, K, SIZE, SIZE, preset=preset, backend="cpu").image
    colors = image.reshape(-1, 3)[pixels]
    colors.backward(cotangent.float())
    return colors.detach().double(), opacities.grad.double()


def errors(
    image: Tensor, gradients: list[Optional[Tensor]], true_image: Tensor, true_gradient: Tensor
) -> dict[str, str]:
    """Return PSNR and relative errors; the second gradient may be None."""
    mse = float((image - true_image).square().mean())
    relative = [
        ""
        if found is None
        else f"{float((found - true_gradient).norm() / true_gradient.norm()):.3g}"
        for found in gradients
    ]
    return dict(zip(COLUMNS[2:5], (f"{-10 * math.log10(mse):.2f}", *relative), strict=True))


def table() -> str:
    """Return the errors of each format and of the presets, and on how many scenes a format has a
    smaller error than a preset.
    """
    rows = read(RESULTS)
    names = list(dict.fromkeys(row["scene"] for row in rows))
    cells = {(row["sums"], row["scene"]): row for row in rows}
    lines = []
    for text in (*FORMATS, *PRESETS):
        own = [cells[text, name] for name in names]
        title = f"preset `{text}`, sums in float32" if text in PRESETS else text
        psnr = (f"{float(row['psnr']):.1f}" for row in own)
        lines.append((title, *psnr, *(_gradients(own, column) for column in COLUMNS[3:5])))
    head = ("sums", *names, "gradient, back to front", "gradient, by subtraction")
    compared = markdown(
        (f"scenes of {len(names)} with a smaller error than", *(f"`{name}`" for name in PRESETS)),
        (
            (f"{text}, {title}", *(str(better(rows, text, column, name)) for name in PRESETS))
            for text in ("float16", "bfloat16")
            for column, title in zip(COLUMNS[2:5], ("image", *head[-2:]), strict=True)
        ),
    )
    return f"{markdown(head, lines)}\n\n{compared}"


def better(rows: list[dict[str, str]], text: str, column: str, preset: str) -> int:
    """Return on how many scenes a format has a smaller error in a column than a preset, whose
    gradients are those of the CPU kernel.
    """
    own = {row["scene"]: float(row[column]) for row in rows if row["sums"] == text}
    other = "psnr" if column == "psnr" else "gradient"
    sign = -1 if column == "psnr" else 1
    compared = (row for row in rows if row["sums"] == preset)
    return sum(sign * own[row["scene"]] < sign * float(row[other]) for row in compared)


def _gradients(rows: list[dict[str, str]], column: str) -> str:
    """Return the error on the trained cloud and the largest of all scenes."""
    found = {row["scene"]: row[column] for row in rows}
    if not found["trained"]:
        return ""
    return f"{float(found['trained']):.1e}, at most {max(map(float, found.values())):.1e}"


if __name__ == "__main__":
    main()
