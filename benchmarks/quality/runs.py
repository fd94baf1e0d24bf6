"""Training runs for the charts: all runs that a chart needs, in parallel on the CPU, into one CSV
per chart.

    python -m benchmarks.quality.runs                               # all missing runs
    python -m benchmarks.quality.runs --charts time --seeds 0 1 2   # one chart, fewer seeds
    python -m benchmarks.quality.runs --list                        # print what would run

Each run is `launch.py` with the base recipe (`recipe.py`) at 128^2 and a few options changed, on
one thread; the charts `quality` and `unseen` take the demo's configurations. It is scored on 24
held-out views, ray-cast from the mesh, that are neither in a bank nor training views. Seconds are
CPU seconds of training, with targets and without evaluation, so other programs hardly affect them.
Rows are appended as runs end, seed by seed, and runs in the CSV are skipped, so the command can be
interrupted. Settings were tuned on the bundled toy (the demo's start on spot too, the draft's steps
and views on the duck too); other objects are given by path and held back."""

import argparse
import csv
import json
import os
import platform
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from typing import Any, Optional

from tqdm import tqdm

from benchmarks.quality.jobs import JOBS, STEPS, WITHOUT_OBJECTS, Job
from benchmarks.quality.recipe import CONFIGS, RECIPE, recipe
from benchmarks.start.launched import commit_of
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu

ROOT = Path(__file__).resolve().parents[2]
CHARTS = ROOT / "docs/charts"
RENDERER = recipe()["system"]["renderer"]
"""The recipe's options of the renderer."""
SIZE, EVERY = 128, 100
WITH_CURVES = ("time",)
MEASURED = ("psnr", "ssim", "multi_face", "floater_mass", "out_of_gamut")
COLUMNS = ["variant", "x", "object", "seed", "step", "cpu_seconds", "gaussians", *MEASURED]
COLUMNS += ["machine", "commit"]


def main() -> None:
    arguments = parse_arguments()
    require_kernel()
    measured = {
        chart: measured_in(chart, "variant", "x", "object", "seed") for chart in arguments.charts
    }
    todo = [
        (job, mesh, seed)
        for seed in arguments.seeds
        for chart in arguments.charts
        for job in JOBS[chart]()
        if arguments.variants is None or job.variant in arguments.variants
        for mesh in arguments.objects
        if (job.variant, f"{job.x:g}", object_name(mesh), str(seed)) not in measured[chart]
    ]
    if arguments.list:
        print(
            "\n".join(
                f"{job.chart}: {job.variant}, {job.x:g}, {object_name(mesh)}, seed {seed}"
                for job, mesh, seed in todo
            )
        )
        return
    with ThreadPoolExecutor(arguments.jobs) as pool:
        running = {
            pool.submit(run, mesh, seed, curve(job) | job.options, job.overlay): (job, mesh, seed)
            for job, mesh, seed in todo
        }
        failed = 0
        for done in tqdm(as_completed(running), total=len(todo), unit="run", disable=None):
            if error := done.exception():
                failed += 1
                tqdm.write(str(error), file=sys.stderr)
            else:
                append(*running[done], done.result())
    sys.exit(f"{failed} of {len(todo)} runs failed" if failed else 0)


def argument_parser(doc: str, seeds: Sequence[int] = (0,)) -> argparse.ArgumentParser:
    """Return a parser with ``--objects`` and ``--seeds``; ``doc``'s first line describes it."""
    parser = argparse.ArgumentParser(description=doc.splitlines()[0])
    parser.add_argument(
        "--objects",
        nargs="*",
        default=["toy.glb"],
        help="meshes; a bare name is a bundled one (default: toy.glb)",
    )
    parser.add_argument("--seeds", type=int, nargs="+", default=list(seeds))
    return parser


def add_jobs(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--jobs", type=int, default=os.cpu_count(), help="runs side by side, one thread each"
    )


def require_kernel() -> None:
    """Exit unless the CPU kernel can run, since plain torch in its place takes many times as long.

    Called by benchmarks that note seconds."""
    if reason := cpu.unavailable():
        sys.exit(f"this would measure plain torch: {reason}")


def measure_missing(
    chart: str,
    columns: list[str],
    arguments: argparse.Namespace,
    measure: Callable[[str, int], Iterable[dict[str, Any]]],
) -> None:
    """Append the rows of every mesh and seed that the chart's CSV doesn't have."""
    done = measured_in(chart, "object", "seed")
    for seed in arguments.seeds:
        for mesh in arguments.objects:
            if (object_name(mesh), str(seed)) not in done:
                append_rows(chart, columns, list(measure(mesh, seed)))


def parse_arguments() -> argparse.Namespace:
    parser = argument_parser(__doc__, seeds=range(5))
    own = [name for name in JOBS if name not in WITHOUT_OBJECTS]
    parser.add_argument("--charts", nargs="+", choices=JOBS, default=own)
    add_jobs(parser)
    parser.add_argument("--variants", nargs="+", help="only these; default: all of the charts")
    parser.add_argument("--list", action="store_true", help="only print what would run")
    return parser.parse_args()


def run(
    mesh: str, seed: int, options: dict[str, Any], overlay: Optional[str] = None
) -> dict[str, Any]:
    """Run one training in a process of its own; return its metrics."""
    with tempfile.TemporaryDirectory() as folder:
        save = train(Path(folder), mesh, seed, options, overlay=overlay)
        return json.loads((save / "metrics.json").read_text())


def train(
    folder: Path,
    mesh: str,
    seed: int,
    options: dict[str, Any],
    *,
    program: str = "launch.py",
    overlay: Optional[str] = None,
) -> Path:
    """Run one training in a process of its own below ``folder``; return the folder of its results.

    Args:
        overlay: name of a file of configs/ that is laid over demo.yaml; "" for none, None for the
            recipe.
    """
    common = {
        "use_timestamp": "false", "tag": "run", "seed": seed, "data.width": SIZE,
        "data.height": SIZE, "system.evaluation.size": SIZE, "system.guidance.mesh": mesh,
        "system.guidance.bank_seed": seed, "data.n_test_views": 1, "data.eval_width": 64,
        "data.eval_height": 64, "trainer.max_steps": STEPS, "trainer.val_check_interval": 100000,
        "trainer.enable_progress_bar": "false",
    }  # fmt: skip
    overrides = [
        f"{key}={value}" for key, value in (common | options | {"exp_root_dir": folder}).items()
    ]
    configs = [f"--config={path}" for path in configs_of(overlay)]
    command = [sys.executable, str(ROOT / program), *configs, "--train", *overrides]
    environment = os.environ | {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
    finished = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment)
    if finished.returncode:
        raise RuntimeError(
            f"a run failed ({finished.returncode}): "
            f"{' '.join(overrides)}\n{finished.stderr[-3000:]}"
        )
    return folder / "demo/run/save"


def configs_of(overlay: Optional[str]) -> list[Path]:
    """Return the configurations of a run; ``overlay`` as in :func:`train`."""
    over = RECIPE if overlay is None else CONFIGS / f"{overlay}.yaml"
    return [CONFIGS / "demo.yaml", *([] if overlay == "" else [over])]


def curve(job: Job) -> dict[str, Any]:
    """Return how often a run is scored, for charts with curves."""
    return {"system.evaluation.every": EVERY if job.chart in WITH_CURVES else 0}


def object_name(mesh: str) -> str:
    return Path(mesh).stem


def measured_in(chart: str, *columns: str) -> set[tuple[str, ...]]:
    """Return the runs in a chart's CSV, by these columns."""
    return {tuple(row[column] for column in columns) for row in rows_of(chart)}


def rows_of(chart: str, folder: Optional[Path] = None) -> list[dict[str, str]]:
    """Return the rows of a chart's CSV, in docs/charts or another folder; an empty list if it
    doesn't exist.
    """
    path = (folder or CHARTS) / f"{chart}.csv"
    if not path.is_file():
        return []
    with open(path, newline="") as file:
        return list(csv.DictReader(file))


def append(job: Job, mesh: str, seed: int, metrics: dict[str, Any]) -> None:
    """Append the curve and the result of one run; a result's ``step`` is the last."""
    start = metrics["prior"] | {"step": 0}
    points = {
        scores["step"]: scores for scores in (start, *metrics.get("curve", ()), metrics["result"])
    }
    place = {"variant": job.variant, "x": f"{job.x:g}", "object": object_name(mesh), "seed": seed}
    append_rows(job.chart, COLUMNS, [scores | place for scores in points.values()])


def append_rows(
    chart: str, columns: list[str], rows: list[dict[str, Any]], folder: Optional[Path] = None
) -> None:
    """Append rows to a chart's CSV, with processor and commit unless a row has its own."""
    path, here = (folder or CHARTS) / f"{chart}.csv", {"machine": machine(), "commit": commit()}
    path.parent.mkdir(parents=True, exist_ok=True)
    new = not path.is_file()
    with open(path, "a", newline="") as file:
        writer = csv.DictWriter(
            file, columns, restval="", extrasaction="ignore", lineterminator="\n"
        )
        if new:
            writer.writeheader()
        writer.writerows(here | row for row in rows)


def machine() -> str:
    """Return the processor's name, if the system reports it."""
    try:
        names = [
            line.partition(":")[2].strip()
            for line in open("/proc/cpuinfo")
            if line.startswith("model name")
        ]
    except OSError:
        names = []
    return names[0] if names else platform.processor() or platform.machine()


def commit() -> str:
    return commit_of(ROOT)


if __name__ == "__main__":
    main()
