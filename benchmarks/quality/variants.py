"""Which score distillation is worth its time: each variant against the exact score of an object.

    python -m benchmarks.quality.variants --objects toy.glb path/to/spot.glb path/to/duck.glb
    python -m benchmarks.quality.variants --lines SDS ISM --seconds 600   # no longer than that
    python -m benchmarks.quality.variants --list                          # print what would run

Each run is the base recipe (`recipe.py`) at 64^2 for 240 steps with one line's options and one
guidance scale. The score knows pictures of the object from the side of the camera
(``direction-bins``) or only pictures from all sides (``view-agnostic``), in a latent of 16^2
pixels; colours aren't bounded, so that saturation shows. All scales are tried on the first object
with all seeds; other objects are run at the scale that is best there, and the paper's recipe,
clipped SDS, at its own, as is the view-blind score at one scale.

``evaluations`` of the score model are one per view and prompt; ``saturation`` is that of the
held-out views relative to the truth's. Rows are appended to docs/charts/variants.csv as runs end,
and runs in it are skipped. ``--pictures`` keeps eight test views of each run, from which
``benchmarks.quality.variant_charts`` computes the diversity over the seeds, and draws."""

import argparse
import csv
import json
import os
import shutil
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from tqdm import tqdm

from benchmarks.quality import forked, runs
from benchmarks.quality.chart_runs import Row, ends, grouped, objects_of
from benchmarks.quality.jobs import BALL, BINS, fixed_timestep, held, steps

CHART = "variants"
STEPS, SIZE, VIEWS = 240, 64, 4
PICTURES = 8
PARTS = 4
"""How often a run is scored."""
COMMON = BINS | {
    "use_timestamp": "false",
    "tag": "run",
    "data.width": SIZE,
    "data.height": SIZE,
    "data.eval_width": SIZE,
    "data.eval_height": SIZE,
    "data.n_test_views": PICTURES,
    "system.guidance.bank_views": 200,
    "system.geometry.bound_colors": "false",
    "system.evaluation.size": runs.SIZE,
    "system.exporter.formats": "[ply]",
    "system.exporter.save_video": "false",
    "trainer.log_every_n_steps": 1,
    "trainer.val_check_interval": 100000,
    "trainer.enable_progress_bar": "false",
}  # fmt: skip
BINNED, BLIND = TRUTHS = ("direction-bins", "view-agnostic")
SCALES = (2.0, 8.5, 31.0, 101.0)
"""threestudio's 1, 7.5, 30 and 100."""
MILD = SCALES[:2]


def falling(schedule: str) -> dict[str, Any]:
    """Return the options of timesteps that fall from 0.98 during the whole run."""
    return {
        "system.guidance.max_step_percent": 0.98,
        "system.guidance.timestep_steps": STEPS,
        "system.guidance.timestep_schedule": schedule,
    }


FALLING = falling("linear")
SDS, CLIPPED = "SDS", "SDS, clipped"
CLIP = {"system.guidance.grad_clip": [0, 1.5, 2.0, STEPS]}


class Line(NamedTuple):
    """A variant with options."""

    variant: str
    options: dict[str, Any]
    own_scale: Optional[float] = None
    """The guidance scale of its paper (CFD's is that of its released configuration, 75), or the
    nearest in ``SCALES``; None if it names none.
    """
    scales: tuple[float, ...] = SCALES


def length(total: int) -> dict[str, Any]:
    """Return the options of a run of ``total`` steps."""
    return steps(total) | {"system.evaluation.every": total // PARTS}


def views(count: int) -> dict[str, Any]:
    """Return the options of a run with ``count`` views a step, and as many views in all."""
    return length(STEPS * VIEWS // count) | {"data.batch_size": count}


def by_error(power: int) -> dict[str, Any]:
    """Return the options of views drawn by their error; see error_views.py."""
    return {
        "data_type": "error-views-datamodule",
        "data.error_power": power,
        "system.guidance_type": "error-measuring-guidance",
    }


DISTILLATIONS = {
    SDS: Line("sds", {}, 101.0),
    CLIPPED: Line("sds", CLIP, 101.0),
    "SDS, rescaled": Line("sds", {"system.guidance.recon_std_rescale": 0.5}),
    "SDS, DreamTime": Line("sds", falling("dreamtime"), 101.0),
    "SDS, t = 0.1": Line("sds", fixed_timestep(0.1)),
    "SDS, t = 0.2": Line("sds", fixed_timestep(0.2)),
    "SDS, t = 0.5": Line("sds", fixed_timestep(0.5)),
    "CSD": Line("csd", {}),
    "NFSD": Line("nfsd", {}, 8.5),
    "VSD": Line("vsd", {}, 8.5),
    "ISM": Line("ism", {}, 8.5),
    "CFD": Line("cfd", FALLING, 101.0),
    "SDI": Line("sdi", FALLING | {"system.guidance.weighting_strategy": "x0"}, 8.5),
}
CHEAPER = {
    "SDS, guidance interval": Line("sds", {"system.guidance.guidance_interval": [0.2, 0.8]}),
    "SDS, falling t": Line("sds", FALLING),
    "SDS, t falling by the root": Line("sds", falling("sqrt")),
    "SDS, a quarter of the steps": Line("sds", length(STEPS // 4), scales=MILD),
    "SDS, a quarter of the steps, t = 0.1": Line(
        "sds", length(STEPS // 4) | fixed_timestep(0.1), scales=MILD
    ),
    "SDS, half the steps": Line("sds", length(STEPS // 2), scales=MILD),
    "SDS, twice the steps": Line("sds", length(STEPS * 2), scales=MILD),
    **{
        f"SDS, {count} view{'s' * (count > 1)}": Line("sds", views(count), scales=MILD)
        for count in (1, 2, 8)
    },
    "SDS, views by error": Line("sds", by_error(1), scales=MILD),
    "SDS, views by its square": Line("sds", by_error(2), scales=MILD),
    "SDS, 4 steps each, 240 steps": Line("sds", length(STEPS) | held(4), scales=MILD),
    "SDS, 2 steps each, 480 steps": Line("sds", length(2 * STEPS) | held(2), scales=MILD),
    "SDS, 4 steps each, 960 steps": Line("sds", length(4 * STEPS) | held(4), scales=MILD),
}
"""SDS with fewer evaluations per step, or fewer steps."""
FROM_BALL = {
    f"{label}, from a ball": line._replace(options=line.options | BALL, scales=SCALES[:1])
    for label, line in (DISTILLATIONS | CHEAPER).items()
    if label == SDS or label.startswith("SDS, t ")
}
"""Timesteps with a first shape that is wrong: a grey ball, as large as the object."""
LINES = DISTILLATIONS | CHEAPER | FROM_BALL
PAPER_SCALE = 101.0
BLIND_LINES = [label for label in DISTILLATIONS if label != "CSD"]
"""CSD is refused, since without a direction there is no difference to follow."""
BLIND_SCALE = 8.5
"""Without effect there: the conditional score is the unconditional one."""
KEY = ("truth", "variant", "x", "object", "seed")
COLUMNS = ["truth", "variant", "x", "object", "seed", "step", "cpu_seconds", "evaluations"]
COLUMNS += ["gaussians", "psnr", "ssim", "multi_face", "out_of_gamut", "saturation"]
COLUMNS += ["machine", "commit"]


class Todo(NamedTuple):
    """One run."""

    truth: str
    label: str
    scale: float
    mesh: str
    seed: int
    pictures: Optional[Path] = None

    @property
    def key(self) -> tuple[str, ...]:
        """Its place in the CSV."""
        return (
            self.truth,
            self.label,
            f"{self.scale:g}",
            runs.object_name(self.mesh),
            str(self.seed),
        )


def main() -> None:
    arguments = parse_arguments()
    runs.require_kernel()
    deadline = time.monotonic() + arguments.seconds
    failed = 0
    for stage in (all_scales, best_scale_only):
        todo = [item for item in stage(arguments) if item.key not in runs.measured_in(CHART, *KEY)]
        if arguments.list:
            print("\n".join(", ".join(item.key) for item in todo))
            continue
        ended = forked.results(measure, todo, arguments.jobs, deadline)
        for item, result in tqdm(ended, total=len(todo), unit="run", disable=None):
            if isinstance(result, Exception):
                failed += 1
                tqdm.write(f"{', '.join(item.key)}: {result}", file=sys.stderr)
            else:
                runs.append_rows(CHART, COLUMNS, result)
    sys.exit(f"{failed} runs failed" if failed else 0)


def parse_arguments() -> argparse.Namespace:
    parser = runs.argument_parser(__doc__)
    parser.add_argument("--lines", nargs="+", choices=LINES, default=list(LINES))
    parser.add_argument("--seconds", type=float, default=float("inf"), help="end after that")
    parser.add_argument("--pictures", type=Path, help="folder for test views of each run")
    runs.add_jobs(parser)
    parser.add_argument("--list", action="store_true", help="only print what would run")
    return parser.parse_args()


def all_scales(arguments: argparse.Namespace) -> Iterator[Todo]:
    """Yield the runs that the choice of scales needs."""
    for seed in arguments.seeds:
        for scale in SCALES:
            for label in (label for label in arguments.lines if scale in LINES[label].scales):
                yield todo_of(arguments, BINNED, label, scale, arguments.objects[0], seed)


def best_scale_only(arguments: argparse.Namespace) -> Iterator[Todo]:
    """Yield the runs at the best scales so far, and the paper's recipe."""
    best = best_scales(runs.rows_of(CHART))
    lines = [label for label in arguments.lines if label in best]
    for seed in arguments.seeds:
        for mesh in arguments.objects:
            for label in lines:
                for scale in sorted(scales_of(label, best)):
                    yield todo_of(arguments, BINNED, label, scale, mesh, seed)
        for mesh in arguments.objects:
            for label in (label for label in BLIND_LINES if label in lines):
                yield todo_of(arguments, BLIND, label, BLIND_SCALE, mesh, seed)


def todo_of(arguments: argparse.Namespace, *place: Any) -> Todo:
    return Todo(*place, pictures=arguments.pictures)


def scales_of(label: str, best: dict[str, str]) -> set[float]:
    """Return the scales at which a line is run with all objects and seeds."""
    return {float(best[label])} | ({PAPER_SCALE} if label == CLIPPED else set())


def best_scales(rows: list[Row]) -> dict[str, str]:
    """Return the scale of each line with the largest median dB at the end on the first object, of
    the scales that were run with all seeds of the one that is best with the first seed.
    """
    rows = [row for row in rows if row["truth"] == BINNED]
    first = (objects_of(rows)[0], rows[0]["seed"]) if rows else ("", "")
    on_first = [row for row in rows if row["object"] == first[0]]
    tried = {(row["variant"], row["x"]) for row in on_first if row["seed"] == first[1]}
    own = [row for row in on_first if (row["variant"], row["x"]) in tried]
    return {
        label: best_of(grouped(found, lambda row: row["x"]), first[1])
        for label, found in grouped(own, lambda row: row["variant"]).items()
    }


def best_of(scales: dict[str, list[Row]], first: str) -> str:
    """Return the best of these scales of a line; each is run with the seed ``first``."""

    def end(scale: str, seeds: set[str]) -> float:
        return median_end([row for row in scales[scale] if row["seed"] in seeds])

    best = max(scales, key=lambda scale: end(scale, {first}))
    seeds = {row["seed"] for row in scales[best]}
    complete = [x for x, own in scales.items() if seeds <= {row["seed"] for row in own}]
    return max(complete, key=lambda scale: end(scale, seeds))


def median_end(rows: list[Row]) -> float:
    return statistics.median(float(row["psnr"]) for row in ends(rows))


def options_of(label: str, scale: float, truth: str = BINNED) -> dict[str, Any]:
    """Return the options of a line's runs at a guidance scale."""
    line = LINES[label]
    chosen = {
        "system.guidance.variant_type": f"{line.variant}-variant",
        "system.guidance.guidance_scale": scale,
        "system.guidance.mode": truth,
    }
    return COMMON | length(STEPS) | line.options | chosen


def measure(todo: Todo) -> list[dict[str, Any]]:
    """Make one run; return its rows, one per scored step."""
    own = {
        "seed": todo.seed,
        "system.guidance.bank_seed": todo.seed,
        "system.guidance.mesh": os.path.abspath(todo.mesh) if os.sep in todo.mesh else todo.mesh,
    }
    with tempfile.TemporaryDirectory() as folder:
        options = options_of(todo.label, todo.scale, todo.truth) | own
        save = forked.train(Path(folder), options)
        metrics = json.loads((save / "metrics.json").read_text())
        per_step = evaluations_per_step(save.parent)
        if todo.pictures:
            keep_pictures(save, todo)
    place = dict(zip(KEY, todo.key, strict=True))
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


def picture_folder(pictures: Path, key: tuple[str, ...]) -> Path:
    """Return the folder of a run's test views."""
    return pictures / "_".join(key).replace(", ", "-").replace(" ", "-")


def keep_pictures(save: Path, todo: Todo) -> None:
    """Copy the test views of a run."""
    (found,) = save.glob("it*-test")
    shutil.copytree(found, picture_folder(todo.pictures, todo.key), dirs_exist_ok=True)


if __name__ == "__main__":
    main()
