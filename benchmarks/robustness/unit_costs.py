"""What one asset costs, stage by stage, and what the farm's driver adds.

    python -m benchmarks.robustness.unit_costs [--seeds 0 1 2]

Runs the demo through the launcher, each time in a new process on one thread, and writes the CPU
seconds and the peak memory at the end of each stage, and the bytes and number of the files that
are left, to docs/charts/unit_costs.csv. Then times the driver's own work for an asset, with workers
that return at once and the ledger on this disk, without Ray's part.
"""

import argparse
import io
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from benchmarks.markdown import read, write
from benchmarks.quality.runs import CHARTS, append_rows
from threestudio_gaussiandreamer.farm.assets import Job, Recipe
from threestudio_gaussiandreamer.farm.board import Beat
from threestudio_gaussiandreamer.farm.display import Display
from threestudio_gaussiandreamer.farm.driver import Driver
from threestudio_gaussiandreamer.farm.ledger import FINISHED, Ledger
from threestudio_gaussiandreamer.farm.rows import Row
from threestudio_gaussiandreamer.farm.worker import Setting
from threestudio_gaussiandreamer.host import pl
from threestudio_gaussiandreamer.launch import experiment
from threestudio_gaussiandreamer.launch.options import parse_arguments

ROOT = Path(__file__).resolve().parents[2]
COLUMNS = ("measured", "name", "seed", "value", "unit", "machine", "commit")
IMPORTS, START = "imports", "configuration, prior, cloud"
TRAINING, TEST, EXPORT = "training, {} steps", "turntable, 120 views", "video, export, pages"
STAGES = (IMPORTS, START, TRAINING, TEST, EXPORT)
"""With the number of steps of the demo that was measured."""
KINDS = {
    "checkpoint": ("ckpts/*",),
    "exported clouds and pages": ("save/*-export/**/*",),
    "pictures and video": ("save/*-test*", "save/*-test/*", "save/*.png", "save/held_out/*"),
}
OTHER = "logs, configuration, prior and others"
WORKERS, ASSETS = (10, 100, 1000, 10_000), 4000


# ---- an asset ------------------------------------------------------------------------------------


class Clock(pl.Callback):
    """Note the CPU seconds and the peak memory of the process at the end of each stage."""

    def __init__(self) -> None:
        self.ends: list[tuple[float, float]] = []
        self.max_steps = 0

    def note(self, *others: Any) -> None:
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        self.ends.append((time.process_time(), peak))

    def on_train_batch_start(self, trainer: Any, *others: Any) -> None:
        if trainer.global_step == 0:
            self.max_steps = trainer.max_steps
            self.note()

    def on_fit_end(self, *others: Any) -> None:
        self.note()

    def on_test_batch_end(self, trainer: Any, *others: Any) -> None:
        if others[3] == trainer.num_test_batches[0] - 1:
            self.note()


def run_asset(seed: int, folder: Path) -> dict[str, Any]:
    """Make an asset in this process; return what :class:`Clock` has noted and the files' sizes."""
    experiment.limit_openmp_spin()
    config = ["--config", str(ROOT / "configs/demo.yaml"), "--train", "--gpu", "cpu"]
    argv = [*config, f"exp_root_dir={folder}", f"seed={seed}", "use_timestamp=false", "tag=run"]
    clock = Clock()
    clock.note()
    arguments = parse_arguments(argv)
    experiment.prepare(arguments, argv, callbacks=[clock], records_code=False).run()  # as a farm
    clock.note()
    files = stored(folder / "demo/run")
    return {"ends": clock.ends, "max_steps": clock.max_steps, "files": files}


def stored(folder: Path) -> dict[str, tuple[int, int]]:
    """Return bytes and number of the files of each kind."""
    left = {path for path in folder.rglob("*") if path.is_file()}
    found = {}
    for kind, patterns in KINDS.items():
        ours = {path for pattern in patterns for path in folder.glob(pattern)} & left
        found[kind], left = ours, left - ours
    found[OTHER] = left
    return {k: (sum(path.stat().st_size for path in v), len(v)) for k, v in found.items()}


def asset_rows(seed: int) -> Iterator[dict[str, Any]]:
    """Make an asset in a process of its own."""
    command = [sys.executable, "-m", __spec__.name, "--run", str(seed)]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    if done.returncode:
        raise RuntimeError(done.stderr[-3000:])
    measured = json.loads(done.stdout.splitlines()[-1])
    before = 0.0
    for name, (seconds, peak) in zip(STAGES, measured["ends"], strict=True):
        stage = name.format(measured["max_steps"])
        yield row("stage", stage, seed, seconds - before, "s")
        yield row("stage", stage, seed, peak, "MB")
        before = seconds
    for kind, (size, count) in measured["files"].items():
        yield row("files", kind, seed, size, "bytes")
        yield row("files", kind, seed, count, "files")


def drop_other_lengths(names: set[str]) -> None:
    """Remove the assets of a demo with another number of steps from the CSV, since the tables sum
    the stages and take medians over all rows.
    """
    path = CHARTS / "unit_costs.csv"
    rows = read(path)
    if {row["name"] for row in rows if row["measured"] == "stage"} <= names:
        return
    write(path, COLUMNS, (row for row in rows if row["measured"] == "driver"))


def row(measured: str, name: str, seed: Any, value: float, unit: str) -> dict[str, Any]:
    place = {"measured": measured, "name": name, "seed": seed, "unit": unit}
    return place | {"value": round(value, 6)}


# ---- the driver ----------------------------------------------------------------------------------


class Handle:
    """Of a call: its outcome, which is there at once."""

    def __init__(self, outcome: Any) -> None:
        self.outcome = outcome


class InstantRay:
    """Ray's calls that the driver makes, with workers that are ready at once."""

    exceptions = SimpleNamespace(RayError=RuntimeError, RayActorError=ConnectionError)

    def wait(self, handles: list[Handle], num_returns: int = 1, timeout: float = 0) -> Any:
        return handles[:num_returns], handles[num_returns:]

    def get(self, handle: Handle, timeout: float = 0) -> Any:
        return handle.outcome


def driver_seconds(workers: int, assets: int, folder: Path) -> tuple[float, int]:
    """Return the driver's seconds per asset, and the bytes that an asset adds to the ledger."""
    jobs = [Job(Row(f"asset-{i}", f"a toy number {i}", i)) for i in range(assets)]
    beats = {i: (Beat("asset-0", 1, "training", 600, 1200), 1.0) for i in range(workers)}
    board = SimpleNamespace(read=SimpleNamespace(remote=lambda: Handle(beats)))
    made = {"state": FINISHED, "key": "", "seconds": 900.0, "steps": 1200, "gaussians": 5000}
    made |= {"hash": "0" * 64, "scores": {"psnr": 30.0}, "picture": "save/it1200-test/0.png"}
    make = SimpleNamespace(remote=lambda job, setting: Handle(dict(made)))
    recipe = Recipe((), (), True, 1)
    settings = [Setting(i, recipe, None, board, "", "", 3) for i in range(workers)]
    ledger = Ledger(folder / f"{workers}.jsonl")
    handles = [SimpleNamespace(make=make)] * workers
    display = Display(assets, 0, io.StringIO())
    driver = Driver(InstantRay(), handles, settings, iter(jobs), ledger, 1800.0, display)
    began = time.perf_counter()
    driver.run()
    seconds = time.perf_counter() - began
    ledger.close()
    return seconds / assets, (folder / f"{workers}.jsonl").stat().st_size // assets


def driver_rows() -> Iterator[dict[str, Any]]:
    with tempfile.TemporaryDirectory() as name:
        for workers in WORKERS:
            seconds, size = driver_seconds(workers, max(ASSETS, workers), Path(name))
            yield row("driver", f"{workers} workers", "", seconds, "s")
        yield row("driver", "ledger", "", size, "bytes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, nargs="*", default=[0, 1, 2])
    parser.add_argument("--run", type=int, help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.run is not None:
        with tempfile.TemporaryDirectory() as folder:
            print(json.dumps(run_asset(arguments.run, Path(folder))))
        return
    append_rows("unit_costs", list(COLUMNS), list(driver_rows()))
    for seed in arguments.seeds:
        rows = list(asset_rows(seed))
        drop_other_lengths({row["name"] for row in rows})
        append_rows("unit_costs", list(COLUMNS), rows)
        print(f"seed {seed} is measured", flush=True)


if __name__ == "__main__":
    main()
