"""Measure dB per byte of spherical harmonics, anisotropy and precision:
docs/charts/attributes.csv and .png.

    python -m benchmarks.quality.attributes                                                  # what
                                                                                     isn't measured
                                                                                     yet, then the
                                                                                     chart
    python -m benchmarks.quality.attributes --objects toy.glb spot.glb duck.glb --seeds 0 1 2

*trained*: clouds of other attributes, trained as the demo is at 128^2 on one thread (`runs.py`),
equal in steps and views, at counts that give round and stretched Gaussians the same number of
floats. *rounded*: the trained cloud of 2,500 with one attribute rounded to so many bits and the
others exact. *file*: the same cloud as the files that it is written to. All scored on 24 held-out
views against ray-cast truth. The truth is unlit, so nothing here looks different from elsewhere: a
glossy scene may need its harmonics.

Trained clouds are kept in outputs/attributes; what the CSV has is not run again.
"""

import argparse
import json
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor
from tqdm import tqdm

from benchmarks.figures import pyplot
from benchmarks.quality.chart_runs import (
    PAPER,
    caption,
    grouped,
    median,
    objects_of,
    papers_ends,
    saved,
    spread,
    title_of,
)
from benchmarks.quality.rounding import ROUNDED
from benchmarks.quality.runs import (
    RENDERER,
    ROOT,
    SIZE,
    STEPS,
    add_jobs,
    append_rows,
    argument_parser,
    measured_in,
    object_name,
    require_kernel,
    rows_of,
    train,
)
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.training.held_out import EvaluationConfig, HeldOut

CLOUDS = ROOT / "outputs/attributes"
COLUMNS = "experiment,variant,x,object,seed,gaussians,bytes,psnr,machine,commit".split(",")
ROUNDED_COUNT = 2500
BITS = (4, 5, 6, 7, 8, 9, 10, 12, 14, 16)
SPZ_BITS = {"opacity": 8, "colour": 8, "scales": 8, "rotation": 10, "positions": 12}
"""How our SPZ files store them; positions by the size of the Gaussians, which is about this along
the longest side.
"""


class Kind(NamedTuple):
    """A cloud with certain attributes."""

    floats: int
    counts: tuple[int, ...]
    options: dict[str, Any]


STRETCHED, ROUND = "stretched, degree 0", "round, degree 0"
KINDS = {
    STRETCHED: Kind(14, (1000, 2500, 5000), {}),
    ROUND: Kind(8, (1750, 4375, 8750), {"system.geometry_type": "round-cloud"}),
} | {
    f"stretched, degree {degree}": Kind(
        11 + 3 * (degree + 1) ** 2,
        (1000, 2500),
        # a twentieth of the rate of the constant harmonic, the custom of 3D Gaussian splatting
        {
            "system.geometry.sh_degree": degree,
            "system.geometry.lr_sh_rest": f"[0,5e-3,1e-4,{STEPS}]",
        },
    )
    for degree in (1, 2, 3)
}


def main() -> None:
    arguments = parse_arguments()
    require_kernel()
    register_parts()
    torch.set_num_threads(1)
    measured = measured_in("attributes", "experiment", "variant", "x", "object", "seed")
    todo = [
        (kind, count, mesh, seed)
        for seed in arguments.seeds
        for kind in KINDS
        for count in KINDS[kind].counts
        for mesh in arguments.objects
        if ("trained", kind, str(count), object_name(mesh), str(seed)) not in measured
    ]
    with ThreadPoolExecutor(arguments.jobs) as pool:
        running = {pool.submit(folder_of, *job): job for job in todo}
        for done in tqdm(as_completed(running), total=len(todo), unit="cloud", disable=None):
            append(running[done], list(rows(*running[done], done.result())))
    if rows_of("attributes"):
        print(draw(rows_of("attributes")))


def parse_arguments() -> argparse.Namespace:
    parser = argument_parser(__doc__)
    add_jobs(parser)
    return parser.parse_args()


# ---- measuring -----------------------------------------------------------------------------------


def folder_of(kind: str, count: int, mesh: str, seed: int) -> Path:
    """Return the results of one training run, which is made unless it exists."""
    folder = (
        CLOUDS / f"{kind.replace(', ', '-').replace(' ', '')}-{count}-{object_name(mesh)}-{seed}"
    )
    results = folder / "demo/run/save"
    if not list(results.glob("it*-export/gaussians.ply")):
        train(
            folder,
            mesh,
            seed,
            KINDS[kind].options | {"system.geometry.budget": count},
            program="benchmarks/quality/round_gaussians.py",
        )
    return results


def rows(kind: str, count: int, mesh: str, seed: int, results: Path) -> Iterator[dict[str, Any]]:
    """Yield the row of a training run, and those of its cloud with rounded attributes."""
    scores = json.loads((results / "metrics.json").read_text())["result"]
    yield {
        "experiment": "trained",
        "variant": kind,
        "x": count,
        "bytes": 4 * KINDS[kind].floats * count,
        **scores,
    }
    if kind != STRETCHED or count != ROUNDED_COUNT:
        return
    exported = read_cloud(str(next(results.glob("it*-export/gaussians.ply"))))
    arrays = exported.in_axes(WORLD_UP).gaussians
    for name, size, cloud in written(arrays):
        yield {
            "experiment": "file",
            "variant": name,
            "x": 0,
            "gaussians": count,
            "bytes": size,
            "psnr": score(mesh, cloud),
        }
    for name, rounded in ROUNDED.items():
        for bits in BITS:
            cloud = rounded(arrays, bits)
            yield {
                "experiment": "rounded",
                "variant": name,
                "x": bits,
                "gaussians": count,
                "bytes": "",
                "psnr": score(mesh, cloud),
            }


def written(arrays: Gaussians) -> Iterator[tuple[str, int, Gaussians]]:
    """Return the cloud as read back from files of each kind, with their sizes."""
    with tempfile.TemporaryDirectory() as folder:
        for name in ("a.ply", "a.spz"):
            path = Path(folder) / name
            write_cloud(str(path), StoredCloud(arrays))
            yield (
                path.suffix[1:].upper(),
                path.stat().st_size,
                read_cloud(str(path)).in_axes(WORLD_UP).gaussians,
            )


def score(mesh: str, arrays: Gaussians, size: int = SIZE, **drawn: Any) -> float:
    """Compute the PSNR on the held-out views as a run does; rendered with the options of the demo,
    except ``drawn``.
    """
    images, truth = held_out_pictures(mesh, arrays, size, **drawn)
    return round(float(psnr(images, truth)), 4)


def held_out_pictures(
    mesh: str, arrays: Gaussians, size: int, *, bound_colors: bool = True, **drawn: Any
) -> tuple[Float[Tensor, "V H W 3"], Float[Tensor, "V H W 3"]]:
    """Render the held-out views of a cloud, in [0, 1], and cast their ground truth, both on white.

    Args:
        bound_colors: clamp the colour of each Gaussian to [0, 1], as viewers do.
        drawn: options of the renderer that differ from the demo's.
    """
    geometry = find("gaussiandreamer-cloud")({"bound_colors": bound_colors})
    geometry.set_arrays(**arrays._asdict())
    background = find("gaussiandreamer-background")({"color": [1.0, 1.0, 1.0]})
    renderer = find("gaussiandreamer-splatting")(
        RENDERER | drawn, geometry=geometry, material=None, background=background
    )
    held_out = held_out_views(mesh, size)
    images, backgrounds = held_out.render(renderer)
    return images.clamp(0, 1), held_out.truth_on(backgrounds)


@cache
def held_out_views(mesh: str, size: int) -> HeldOut:
    return HeldOut(EvaluationConfig(size=size), MeshCaster(load_mesh(mesh)))


def append(job: tuple[str, int, str, int], measurements: list[dict[str, Any]]) -> None:
    append_rows(
        "attributes",
        COLUMNS,
        [row | {"object": object_name(job[2]), "seed": job[3]} for row in measurements],
    )


# ---- rounding, in the steps of SPZ where the number of bits is SPZ's -----------------------------


# ---- drawing -------------------------------------------------------------------------------------


def draw(measurements: list[dict[str, str]]) -> Path:
    """Draw one column per object: the effect of attributes per byte above, of rounding below;
    return the path.
    """
    plt = pyplot()

    objects = objects_of(measurements)
    figure, panels = plt.subplots(
        2, len(objects), figsize=(1.2 + 4.2 * len(objects), 8.4), sharey="row", squeeze=False
    )
    for column, name in enumerate(objects):
        chosen = [row for row in measurements if row["object"] == name]
        draw_bytes(panels[0, column], chosen)
        draw_bits(panels[1, column], chosen)
        panels[0, column].set_title(title_of(name), fontsize=10)
    panels[0, 0].set_ylabel("held-out PSNR, dB")
    panels[1, 0].set_ylabel("dB lost by rounding one attribute")
    figure.legend(
        *panels[0, 0].get_legend_handles_labels(),
        loc="center",
        bbox_to_anchor=(0.5, 0.45),
        ncols=7,
        frameon=False,
        fontsize=8,
    )
    panels[1, -1].legend(loc="upper right", frameon=False, fontsize=8)
    figure.suptitle("Which attributes a scene needs", x=0.01, ha="left", fontweight="bold")
    figure.text(0.01, 0.945, caption(measurements), fontsize=8, color="0.35")
    figure.tight_layout(rect=(0, 0, 1, 0.95), h_pad=4)
    return saved(figure, "attributes")


def draw_bytes(panel: Any, measurements: list[dict[str, str]]) -> None:
    """Draw dB against bytes: float32 of each kind of cloud, and the compact file as a star."""
    trained = [row for row in measurements if row["experiment"] == "trained"]
    lines = grouped(trained, lambda row: row["variant"])
    for index, label in enumerate(kind for kind in KINDS if kind in lines):
        points = sorted(
            (median(at, "bytes") / 1000, *spread(at))
            for at in grouped(lines[label], lambda row: row["x"]).values()
        )
        x, low, middle, high = zip(*points, strict=True)
        panel.plot(
            x,
            middle,
            "o-",
            color=f"C{index}",
            linewidth=1.4,
            markersize=4,
            label=f"{label}, float32",
        )
        panel.vlines(x, low, high, color=f"C{index}", linewidth=1)
    files = [row for row in measurements if (row["experiment"], row["variant"]) == ("file", "SPZ")]
    panel.plot(
        median(files, "bytes") / 1000,
        spread(files)[1],
        "D",
        color="C9",
        markersize=7,
        label=f"{STRETCHED}, SPZ",
    )
    papers = [row for row in papers_ends() if row["object"] == measurements[0]["object"]]
    paper_bytes = 4 * KINDS[STRETCHED].floats * median(papers, "gaussians")
    panel.plot(paper_bytes / 1000, spread(papers)[1], "*", color="0.15", markersize=12, label=PAPER)
    finish(panel, "kB")
    panel.set_xscale("log")
    panel.set_xticks([50, 100, 200, 500], ["50", "100", "200", "500"])
    panel.minorticks_off()


def draw_bits(panel: Any, measurements: list[dict[str, str]]) -> None:
    """Draw dB lost against bits, attribute by attribute, with a ring at the bits of SPZ."""
    exact = {
        row["seed"]: float(row["psnr"])
        for row in measurements
        if (row["experiment"], row["variant"]) == ("file", "PLY")
    }
    rounded = [row for row in measurements if row["experiment"] == "rounded"]
    for index, (label, chosen) in enumerate(grouped(rounded, lambda row: row["variant"]).items()):
        lost = grouped(chosen, lambda row: int(row["x"]))
        x = sorted(lost)
        y = [
            float(np.median([exact[row["seed"]] - float(row["psnr"]) for row in lost[bits]]))
            for bits in x
        ]
        panel.plot(x, y, "o-", color=f"C{index}", linewidth=1.4, markersize=3, label=label)
        panel.plot(
            SPZ_BITS[label],
            y[x.index(SPZ_BITS[label])],
            "o",
            color=f"C{index}",
            markersize=9,
            fillstyle="none",
        )
    panel.set_ylim(-0.02, 1.0)
    finish(panel, "bits (rings: SPZ)")


def finish(panel: Any, x_label: str) -> None:
    panel.set_xlabel(x_label)
    panel.grid(alpha=0.25)
    panel.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
