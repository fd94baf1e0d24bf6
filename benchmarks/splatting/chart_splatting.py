"""Error against milliseconds of the rasteriser, forward and gradients: docs/charts/rasteriser.csv
and two pictures.

    python -m benchmarks.splatting.chart_splatting              # measure and draw
    python -m benchmarks.splatting.chart_splatting --from-csv   # draw what was measured

The reference is the specification in float64 without cutoffs (no smallest alpha, no early
termination, no tiles: every pixel against every Gaussian), at random pixels; gradients are those of
a random cotangent on the same pixels. The cap of alpha is part of the image model and stays on.
Settings are varied one at a time; other libraries' cutoffs are settings of our kernel, which says
nothing about their speed. Times are medians over 20 renders, with the quartiles in the CSV.
"""

import argparse
import csv
import itertools
import math
import os
import statistics
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import Tensor

from benchmarks.figures import pyplot
from benchmarks.splatting.bench_scenes import Scene, make_camera
from benchmarks.splatting.bench_splatting import describe_machine
from benchmarks.splatting.scenes import scenes
from threestudio_gaussiandreamer.splatting import RasterizeOptions, rasterize, reference
from threestudio_gaussiandreamer.splatting import scene as kernel_scene
from threestudio_gaussiandreamer.splatting.projection import project

ROOT = Path(__file__).resolve().parents[2]
CSV = ROOT / "docs/charts/rasteriser.csv"
SIZES = (128, 512, 1024)
PIXELS = 1024
REPETITIONS = 20
ATTRIBUTES = Scene._fields
GREY = 255


class Setting(NamedTuple):
    """One point of the chart."""

    group: str
    name: str
    options: dict[str, Any]


def settings() -> Iterator[Setting]:
    for below in (64, 255, 1024, 4096, 16384, 65536):
        yield Setting("alpha_min", f"1/{below}", {"alpha_min": 1 / below})
    yield Setting("alpha_min", "0", {"alpha_min": 0.0})
    for stop in (0.0, 1e-6, 1e-2):
        yield Setting("stop", f"{stop:g}", {"preset": "accurate", "stop": stop})
    for preset in ("fast", "balanced", "accurate"):
        yield Setting("preset", preset, {"preset": preset})
    yield Setting(
        "other libraries' cutoffs", "alpha 1/255 to 0.99", {"alpha_min": 1 / 255, "alpha_max": 0.99}
    )
    yield Setting(
        "other libraries' cutoffs",
        "alpha 1/255 to 0.999",
        {"alpha_min": 1 / 255, "alpha_max": 0.999},
    )


# ---- the scenes ----------------------------------------------------------------------------------


# ---- measuring -----------------------------------------------------------------------------------


class Truth(NamedTuple):
    """Values of the specification at some pixels."""

    pixels: Tensor
    """(P,) flat indices."""
    image: Tensor
    """(P, 3) float64."""
    cotangent: Tensor
    """(P, 3)."""
    gradients: list[Tensor]


def truth(scene: Scene, size: int) -> Truth:
    """Compute colours and gradients at ``PIXELS`` random pixels, in float64, without any cutoff
    except the cap.
    """
    rng = torch.Generator().manual_seed(size)
    pixels = torch.randperm(size * size, generator=rng)[:PIXELS].sort().values
    cotangent = torch.randn(len(pixels), 3, generator=rng, dtype=torch.float64) / len(pixels)
    leaves = [x.double().requires_grad_() for x in scene]
    options, ordered, centres = at_pixels(leaves, size, pixels)
    chunks = centres.split(64)
    image = torch.cat(
        [
            reference._blend_in_bounded_memory(True, chunk, ordered, options, None)[0]
            for chunk in chunks
        ]
    )[:, :3]
    image.backward(cotangent)
    return Truth(pixels, image.detach(), cotangent, [x.grad for x in leaves])


def at_pixels(
    leaves: list[Tensor], size: int, pixels: Tensor
) -> tuple[RasterizeOptions, reference.Sorted, Tensor]:
    """Return options without cutoffs, the sorted splats of a scene in float64, and the centres of
    some pixels, for the reference.
    """
    viewmat, K = (x[None].double() for x in make_camera(size))
    options = RasterizeOptions(alpha_min=0.0, stop=0.0)
    *attributes, colors = leaves
    background = torch.zeros(1, 3, dtype=torch.float64)
    view = kernel_scene.Scene(*attributes, viewmat, colors, background, K, size, size)
    splats = project(view, options)
    ordered = reference.sort(splats, leaves[4][None], 0)
    return options, ordered, reference.pixel_centres(size, size, splats.depths)[pixels]


def measured(scene: Scene, size: int, setting: Setting, true: Truth) -> dict[str, float]:
    """Measure errors and times of one setting."""
    leaves = [x.clone().requires_grad_() for x in scene]
    viewmat, K = (x[None] for x in make_camera(size))
    cotangent = (
        torch.zeros(size * size, 3)
        .index_copy(0, true.pixels, true.cotangent.float())
        .reshape(1, size, size, 3)
    )

    def step() -> tuple[float, float, Tensor]:
        for leaf in leaves:
            leaf.grad = None
        start = time.perf_counter()
        image = rasterize(*leaves, viewmat, K, size, size, **setting.options).image
        middle = time.perf_counter()
        image.backward(cotangent)
        return middle - start, time.perf_counter() - middle, image.detach()

    step()
    forward, backward, images = zip(*(step() for _ in range(REPETITIONS)), strict=True)
    picture = images[-1].reshape(-1, 3)[true.pixels].double()
    return (
        forward_errors(picture, true.image)
        | gradient_errors(leaves, true)
        | times("forward", forward)
        | times("backward", backward)
    )


def forward_errors(image: Tensor, true: Tensor) -> dict[str, float]:
    """Return PSNR, and the largest and 99.9 % error in grey levels."""
    error = (image - true).abs()
    mse = float((error**2).mean())
    return {
        "psnr": -10 * math.log10(mse) if mse else math.inf,
        "max": GREY * float(error.max()),
        "p999": GREY * float(error.quantile(0.999)),
    }


def gradient_errors(leaves: list[Tensor], true: Truth) -> dict[str, float]:
    """Return relative L2 error and cosine per attribute, and the worst of both."""
    errors, cosines = {}, {}
    for name, leaf, exact in zip(ATTRIBUTES, leaves, true.gradients, strict=True):
        if name == "quats" and bool((leaves[2] == leaves[2][:, :1]).all()):
            continue  # a round Gaussian can be turned as one likes: the gradient is zero
        found = leaf.grad.double()
        errors[f"l2_{name}"] = float((found - exact).norm() / exact.norm())
        cosines[f"cos_{name}"] = float(
            torch.nn.functional.cosine_similarity(found.flatten(), exact.flatten(), dim=0)
        )
    return errors | cosines | {"l2": max(errors.values()), "cos": min(cosines.values())}


def times(name: str, seconds: tuple[float, ...]) -> dict[str, float]:
    low, middle, high = statistics.quantiles(seconds, n=4)
    return {f"{name}_ms": 1e3 * middle, f"{name}_q1": 1e3 * low, f"{name}_q3": 1e3 * high}


def measure() -> list[dict[str, Any]]:
    from tqdm import tqdm

    rows, about = [], describe_machine()
    cells = list(itertools.product(scenes().items(), SIZES))
    for (name, scene), size in tqdm(cells, unit="scene", disable=None):
        true = truth(scene, size)
        for setting in settings():
            where = {"scene": name, "size": size, "group": setting.group, "setting": setting.name}
            values = {
                key: float(f"{value:.6g}")
                for key, value in measured(scene, size, setting, true).items()
            }
            rows.append(where | values | {"load": round(os.getloadavg()[0], 1), "machine": about})
    return rows


# ---- drawing -------------------------------------------------------------------------------------


class Axes(NamedTuple):
    """The content of one picture."""

    file: str
    title: str
    x: str
    y: str
    label: str
    log: bool


PICTURES = (
    Axes(
        "rasteriser_forward.png",
        "Forward error against time",
        "forward_ms",
        "psnr",
        "PSNR to the exact picture, dB",
        False,
    ),
    Axes(
        "rasteriser_gradient.png",
        "Gradient error against time",
        "both_ms",
        "l2",
        "worst relative L2 error of an attribute",
        True,
    ),
)


def draw(rows: list[dict[str, str]]) -> None:
    plt = pyplot()

    names = list(dict.fromkeys(row["scene"] for row in rows))
    for axes in PICTURES:
        figure, panels = plt.subplots(2, 3, figsize=(13, 8))
        for panel, name in zip(panels.flat, names, strict=True):
            draw_panel(panel, axes, [row for row in rows if row["scene"] == name])
            panel.set_title(name, fontsize=10)
        for panel in panels[:, 0]:
            panel.set_ylabel(axes.label)
        for panel in panels[1]:
            panel.set_xlabel(
                "milliseconds a picture"
                + (", forward" if axes.x == "forward_ms" else ", forward and backward")
            )
        figure.suptitle(axes.title, x=0.01, ha="left", fontweight="bold")
        loads = [float(row["load"]) for row in rows]
        figure.text(
            0.01,
            0.945,
            f"{rows[0]['machine']}; load {min(loads)} to {max(loads)}",
            fontsize=8,
            color="0.35",
        )
        handles, labels = panels.flat[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="lower center", ncols=6, frameon=False, fontsize=9)
        figure.tight_layout(rect=(0, 0.04, 1, 0.95))
        figure.savefig(CSV.parent / axes.file, dpi=100)
        plt.close(figure)
        print(CSV.parent / axes.file)


def draw_marks(
    panel: Any, axes: Axes, rows: list[dict[str, str]], color: str, labelled: bool
) -> None:
    """Mark presets, stops and the other libraries' cutoffs; presets with their initial."""
    for group, marker in (("preset", "D"), ("stop", "x"), ("other libraries' cutoffs", "^")):
        marks = [row for row in rows if row["group"] == group]
        label = group if labelled else None
        panel.plot(*columns(axes, marks), marker, color=color, markersize=6, label=label)
        for row in marks if group == "preset" else ():
            beside = {"textcoords": "offset points", "xytext": (5, -3)}
            panel.annotate(row["setting"][0], place(axes, row), **beside, fontsize=7)


def draw_panel(panel: Any, axes: Axes, rows: list[dict[str, str]]) -> None:
    """Draw, for each size, the smallest alpha as a line, presets and other settings as marks, and
    the Pareto front of all as a dashed line.
    """
    for index, size in enumerate(SIZES):
        here, color = [row for row in rows if int(row["size"]) == size], f"C{index}"
        line = sorted(
            (row for row in here if row["group"] == "alpha_min"),
            key=lambda row: -smallest_alpha(row["setting"]),
        )
        thin = {"color": color, "markersize": 3, "linewidth": 1, "alpha": 0.6}
        panel.plot(*columns(axes, line), "o-", label=f"alpha_min, {size}²", **thin)
        label = "front of all settings" if index == 2 else None
        panel.plot(*front(axes, here), "--", color=color, linewidth=0.8, label=label)
        draw_marks(panel, axes, here, color, labelled=index == 2)
    panel.set_xscale("log")
    if axes.log:
        panel.set_yscale("log")
    panel.grid(alpha=0.25)
    panel.spines[["top", "right"]].set_visible(False)


def smallest_alpha(setting: str) -> float:
    """Parse "1/255" or "0"."""
    numerator, _, denominator = setting.partition("/")
    return float(numerator) / float(denominator or 1)


def place(axes: Axes, row: dict[str, str]) -> tuple[float, float]:
    """Return (milliseconds, error) of one setting."""
    backward = float(row["backward_ms"]) if axes.x == "both_ms" else 0.0
    return float(row["forward_ms"]) + backward, float(row[axes.y])


def columns(axes: Axes, rows: list[dict[str, str]]) -> tuple[list[float], list[float]]:
    places = [place(axes, row) for row in rows]
    return [x for x, _ in places], [y for _, y in places]


def front(axes: Axes, rows: list[dict[str, str]]) -> tuple[list[float], list[float]]:
    """Return the settings that no other one beats in both time and error (the Pareto front)."""
    better = (lambda a, b: a < b) if axes.log else (lambda a, b: a > b)
    best: list[dict[str, str]] = []
    for row in sorted(rows, key=lambda row: place(axes, row)[0]):
        if not best or better(float(row[axes.y]), float(best[-1][axes.y])):
            best.append(row)
    return columns(axes, best)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--from-csv", action="store_true", help="draw what was measured")
    if not parser.parse_args().from_csv:
        rows = measure()
        CSV.parent.mkdir(parents=True, exist_ok=True)
        with open(CSV, "w", newline="") as file:
            writer = csv.DictWriter(file, dict.fromkeys(key for row in rows for key in row))
            writer.writeheader()
            writer.writerows(rows)
    with open(CSV, newline="") as file:
        draw(list(csv.DictReader(file)))


if __name__ == "__main__":
    main()
