"""Which score distillation is worth its time: each variant against the exact score of an object.

    python -m benchmarks.quality.variants                            # all missing runs, then charts
    python -m benchmarks.quality.variants --variants csd ism --scales 7.5 --seeds 0 1 2
    python -m benchmarks.quality.variants --list                     # print what would run

Each run trains configs/demo.yaml at 64^2 for 240 steps with one variant and one guidance scale. The
score knows pictures of the object from the side of the camera (`mode: direction-bins`), in a latent
of 16^2 pixels; colours aren't bounded, so that saturation shows. ``evaluations`` of the score model
are one per view and prompt; ``saturation`` is that of the held-out views relative to the truth's.
Rows are appended to docs/charts/variants.csv as runs end, and runs in it are skipped. The
charts show each variant at the scale with the best median, and the paper's recipe, clipped SDS at
100: docs/charts/variants_seconds.png and variants_evaluations.png."""

import argparse
import csv
import json
import statistics
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, NamedTuple

from tqdm import tqdm

from benchmarks.quality import runs
from benchmarks.quality.chart_runs import PAPER, SECONDS, Chart, Row, draw, ends, grouped
from benchmarks.quality.jobs import BINS, steps

CHART = "variants"
STEPS, SIZE = 240, 64
COMMON = BINS | steps(STEPS) | {
    "data.width": SIZE,
    "data.height": SIZE,
    "system.guidance.bank_views": 200,
    "system.geometry.bound_colors": "false",
    "system.evaluation.every": STEPS // 6,
    "trainer.log_every_n_steps": 1,
}  # fmt: skip
SCALES = (2.0, 8.5, 31.0, 101.0)
"""threestudio's 1, 7.5, 30 and 100."""
FALLING = {
    "system.guidance.max_step_percent": 0.98,
    "system.guidance.timestep_steps": STEPS,
    "system.guidance.timestep_schedule": "linear",
}
CLIPPED = "SDS, clipped"
CLIP = {"system.guidance.grad_clip": [0, 1.5, 2.0, STEPS]}


class Line(NamedTuple):
    """A variant with options."""

    variant: str
    options: dict[str, Any]


LINES = {
    "SDS": Line("sds", {}),
    CLIPPED: Line("sds", CLIP),
    "SDS, rescaled": Line("sds", {"system.guidance.recon_std_rescale": 0.5}),
    "SDS, guidance interval": Line("sds", {"system.guidance.guidance_interval": [0.2, 0.8]}),
    "SDS, DreamTime": Line("sds", FALLING | {"system.guidance.timestep_schedule": "dreamtime"}),
    "CSD": Line("csd", {}),
    "NFSD": Line("nfsd", {}),
    "VSD": Line("vsd", {}),
    "SDI": Line("sdi", FALLING | {"system.guidance.weighting_strategy": "x0"}),
    "ISM": Line("ism", {}),
    "CFD": Line("cfd", FALLING),
}
PAPER_SCALE = 101.0
COLUMNS = ["variant", "x", "object", "seed", "step", "cpu_seconds", "evaluations"]
COLUMNS += ["gaussians", "psnr", "ssim", "multi_face", "out_of_gamut", "saturation"]
COLUMNS += ["machine", "commit"]


class Todo(NamedTuple):
    """One run."""

    label: str
    scale: float
    mesh: str
    seed: int


def main() -> None:
    arguments = parse_arguments()
    todo = list(missing(arguments))
    if arguments.list:
        print("\n".join(f"{t.label}, scale {t.scale:g}, {t.mesh}, seed {t.seed}" for t in todo))
        return
    failed = 0
    with ThreadPoolExecutor(arguments.jobs) as pool:
        running = {pool.submit(measure, item): item for item in todo}
        for done in tqdm(as_completed(running), total=len(todo), unit="run", disable=None):
            if error := done.exception():
                failed += 1
                tqdm.write(str(error), file=sys.stderr)
            else:
                runs.append_rows(CHART, COLUMNS, done.result())
    draw_charts(runs.rows_of(CHART))
    sys.exit(f"{failed} of {len(todo)} runs failed" if failed else 0)


def parse_arguments() -> argparse.Namespace:
    parser = runs.argument_parser(__doc__)
    parser.add_argument(
        "--variants", nargs="+", choices=sorted({line.variant for line in LINES.values()})
    )
    parser.add_argument("--scales", type=float, nargs="+", default=list(SCALES))
    runs.add_jobs(parser)
    parser.add_argument("--list", action="store_true", help="only print what would run")
    return parser.parse_args()


def missing(arguments: argparse.Namespace) -> Iterator[Todo]:
    """Yield the runs that the CSV doesn't have."""
    done = runs.measured_in(CHART, "variant", "x", "object", "seed")
    for seed in arguments.seeds:
        for mesh in arguments.objects:
            for scale in arguments.scales:
                for label, line in LINES.items():
                    wanted = arguments.variants is None or line.variant in arguments.variants
                    key = label, f"{scale:g}", runs.object_name(mesh), str(seed)
                    if wanted and key not in done:
                        yield Todo(label, scale, mesh, seed)


def options_of(label: str, scale: float) -> dict[str, Any]:
    """Return the options of a line's runs at a guidance scale."""
    line = LINES[label]
    chosen = {
        "system.guidance.variant_type": f"{line.variant}-variant",
        "system.guidance.guidance_scale": scale,
    }
    return COMMON | line.options | chosen


def measure(todo: Todo) -> list[dict[str, Any]]:
    """Make one run; return its rows, one per scored step."""
    with tempfile.TemporaryDirectory() as folder:
        save = runs.train(Path(folder), todo.mesh, todo.seed, options_of(todo.label, todo.scale))
        metrics = json.loads((save / "metrics.json").read_text())
        per_step = evaluations_per_step(save.parent)
    place = {"variant": todo.label, "x": f"{todo.scale:g}", "seed": todo.seed}
    place |= {"object": runs.object_name(todo.mesh)}
    points = {scores["step"]: scores for scores in (*metrics["curve"], metrics["result"])}
    return [
        scores | place | {"evaluations": f"{per_step * step:.0f}"}
        for step, scores in points.items()
    ]


def evaluations_per_step(folder: Path) -> float:
    """Return the mean of the logged evaluations of the score model."""
    (log,) = folder.glob("csv_logs/version_*/metrics.csv")
    with open(log, newline="") as file:
        values = [row.get("train/evaluations") for row in csv.DictReader(file)]
    return statistics.mean(float(value) for value in values if value)


# ---- charts --------------------------------------------------------------------------------------


def best_scales(rows: list[Row]) -> dict[str, str]:
    """Return the scale of each line with the largest median dB at the end, over all objects."""

    def median_end(same: list[Row]) -> float:
        of_objects = grouped(same, lambda row: row["object"]).values()
        return statistics.median(float(row["psnr"]) for own in of_objects for row in ends(own))

    best = {}
    for label, own in grouped(rows, lambda row: row["variant"]).items():
        scales = grouped(own, lambda row: row["x"])
        best[label] = max(scales, key=lambda x: median_end(scales[x]))
    return best


def at_best(rows: list[Row]) -> list[Row]:
    """Return the rows of each line at its best scale, which its label then has."""
    best = best_scales(rows)
    return [
        row | {"variant": f"{row['variant']}, s = {row['x']}"}
        for row in rows
        if row["x"] == best[row["variant"]]
    ] + [
        row | {"variant": PAPER}
        for row in rows
        if row["variant"] == CLIPPED and row["x"] == f"{PAPER_SCALE:g}" != best[CLIPPED]
    ]


def draw_charts(rows: list[Row]) -> None:
    if not rows:
        return
    title = "Variants of score distillation at their best guidance scales s"
    axes = {"cpu_seconds": SECONDS, "evaluations": "evaluations of the score model"}
    for column, label in axes.items():
        chart = Chart(title, column, label, curves=True, size=SIZE)
        print(draw(f"{CHART}_{column.removeprefix('cpu_')}", chart, at_best(rows)))


if __name__ == "__main__":
    main()
