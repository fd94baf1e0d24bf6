"""Polish a dense cloud of another program: how many of 262,144 Gaussians remain at 40 dB, and what
refinement by score does afterwards: docs/charts/polish.csv and .png.

    python -m benchmarks.quality.polish --objects path/to/spot.glb --seeds 0 1 2
    python -m benchmarks.quality.polish --objects path/to/spot.glb --count 20000 --steps 50
    python -m benchmarks.quality.polish --objects                            # the chart only

The cloud is made of points that are uniform on the mesh, with its colours, as large as the distance
to the nearest point, in a PLY with TripoSplat's axes. *pruned*: rounds of the prune command's
pruning down to 40 dB to that cloud, at 128^2. *prior* and *refined*: `configs/polish.yaml` over
`configs/demo.yaml`, with as many Gaussians as remained for its budget; dB to ray-cast views of the
mesh. What the CSV has is not run again."""

import argparse
import json
import statistics
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch

from benchmarks.figures import pyplot
from benchmarks.quality.chart_runs import grouped, saved
from benchmarks.quality.runs import (
    append_rows,
    argument_parser,
    object_name,
    require_kernel,
    rows_of,
    train,
)
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.formats.producers import GAUSSIANS, producer_axes, to_y_up
from threestudio_gaussiandreamer.gaussians.axes import VIEWER_UP, rotate, rotation_between
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.grow import nearest_distance_scales
from threestudio_gaussiandreamer.gaussians.recover import Recovery, Round
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0
from threestudio_gaussiandreamer.gaussians.simplify import Budget, simplify
from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import sample_surface, surface_colors
from threestudio_gaussiandreamer.prune.options import PruneOptions
from threestudio_gaussiandreamer.prune.pipeline import views_of

CHART, PRODUCER = "polish", "triposplat"
COLUMNS = "object,seed,method,gaussians,psnr,cpu_seconds,machine,commit".split(",")
SIZE, DECIBELS, OPACITY = 128, 40.0, 0.95


def main() -> None:
    parser = argument_parser(__doc__)
    parser.add_argument("--count", type=int, default=262_144, help="Gaussians (default: 262144)")
    parser.add_argument("--steps", type=int, default=600, help="of refinement (default: 600)")
    arguments = parser.parse_args()
    require_kernel()
    register_parts()
    for seed in arguments.seeds:
        for mesh in arguments.objects:
            measure(mesh, seed, arguments)
    if rows_of(CHART):
        print(draw())


def measure(mesh: str, seed: int, arguments: argparse.Namespace) -> None:
    """Append the rows that the CSV doesn't have: the rounds of pruning, then the start and the
    result of refinement.
    """
    common = {"object": object_name(mesh), "seed": seed}
    cloud = dense_cloud(mesh, seed, arguments.count)
    done = [
        row
        for row in rows_of(CHART)
        if row["object"] == common["object"] and row["seed"] == str(seed)
    ]
    if not done:
        done = list(pruned(cloud))
        append_rows(CHART, COLUMNS, [common | row for row in done])
    if done[-1]["method"] == "pruned":
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "dense.ply"
            write_cloud(str(path), as_triposplat(cloud))
            found = refined(path, mesh, seed, int(done[-1]["gaussians"]), arguments.steps)
            append_rows(CHART, COLUMNS, [common | row for row in found])


def dense_cloud(mesh: str, seed: int, count: int) -> Gaussians:
    """Return ``count`` round Gaussians on the surface of a mesh, z up, as arrays."""
    surface = load_mesh(mesh)
    points, faces, barycentric = sample_surface(surface, count, np.random.default_rng(seed))
    points = points.astype(np.float32)
    scales = np.log(nearest_distance_scales(points, "rms3"))
    colors = torch.from_numpy(surface_colors(surface, faces, barycentric))
    return Gaussians(
        means=points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.repeat(scales[:, None], 3, 1).astype(np.float32),
        logit_opacities=np.full(count, np.log(OPACITY / (1 - OPACITY)), np.float32),
        sh=rgb_to_sh0(colors)[:, None].numpy(),
    )


def as_triposplat(cloud: Gaussians) -> StoredCloud:
    """Return the cloud in the axes of TripoSplat's files."""
    to_file = to_y_up(producer_axes(PRODUCER, GAUSSIANS)).T @ rotation_between("z", "y")
    return StoredCloud(rotate(cloud, to_file), VIEWER_UP)


def pruned(cloud: Gaussians) -> Iterator[dict[str, Any]]:
    """Yield the number of Gaussians and the PSNR to the dense cloud after each round."""
    stored = StoredCloud(cloud)
    train_views, val_views, _ = views_of(stored, PruneOptions(size=SIZE))
    rounds: list[dict[str, Any]] = []
    started = time.process_time()

    def report(done: Round) -> None:
        seconds = round(time.process_time() - started)
        rounds.append(as_row("pruned", done.count, done.psnr, seconds))
        print(rounds[-1], flush=True)

    tensors = cloud.tensors()
    recovery = Recovery(tensors, train_views, val_views, steps=PruneOptions.steps)
    simplify(tensors, Budget(psnr=DECIBELS), recovery, report=report)
    yield from rounds


def refined(path: Path, mesh: str, seed: int, budget: int, steps: int) -> Iterator[dict[str, Any]]:
    """Yield the PSNR to the mesh before and after `configs/polish.yaml` with that budget."""
    options = {
        "system.geometry.prior.path": path,
        "system.geometry.budget": budget,
        "trainer.max_steps": steps,
    }
    save = train(path.parent / "run", mesh, seed, options, overlay="polish")
    metrics = json.loads((save / "metrics.json").read_text())
    for method in ("prior", "result"):
        found = metrics[method]
        name = "refined" if method == "result" else method
        yield as_row(name, found["gaussians"], found["psnr"], round(found["cpu_seconds"]))


def as_row(method: str, gaussians: int, psnr: float, seconds: int) -> dict[str, Any]:
    return {
        "method": method,
        "gaussians": gaussians,
        "psnr": round(float(psnr), 2),
        "cpu_seconds": seconds,
    }


def draw() -> Path:
    """Draw the rounds of pruning of each object; return the figure's path."""
    from matplotlib import ticker

    plt = pyplot()

    figure, panel = plt.subplots(figsize=(6.4, 4.2))
    rounds = [row for row in rows_of(CHART) if row["method"] == "pruned"]
    for number, (name, own) in enumerate(grouped(rounds, lambda row: row["object"]).items()):
        runs = grouped(own, lambda row: row["seed"]).values()
        remain = statistics.median(int(run[-1]["gaussians"]) for run in runs)
        label: Optional[str] = f"{name}: {remain:,.0f}"
        for run in runs:
            counts, decibels = ([float(row[key]) for row in run] for key in ("gaussians", "psnr"))
            panel.plot(counts, decibels, "o-", color=f"C{number}", label=label, markersize=4)
            label = None
    panel.axhline(DECIBELS, color="0.6", linestyle=":")
    panel.set(xlabel="Gaussians that remain", ylabel="PSNR to the dense cloud, dB")
    panel.xaxis.set_major_formatter(ticker.StrMethodFormatter("{x:,.0f}"))
    panel.margins(y=0.12)
    panel.grid(alpha=0.25)
    panel.legend(frameon=False, title="Gaussians in the end, median", loc="lower right")
    machines, commits = (", ".join(sorted({row[key] for row in rounds})) for key in COLUMNS[-2:])
    figure.suptitle("Pruning a dense cloud of 262,144 Gaussians", x=0.01, ha="left")
    seeds = len({row["seed"] for row in rounds})
    figure.text(0.01, 0.9, f"{SIZE}², {seeds} seeds; {machines}; commit {commits}", fontsize=8)
    figure.tight_layout(rect=(0, 0, 1, 0.95))
    return saved(figure, CHART)


if __name__ == "__main__":
    main()
