"""Processor seconds from ``launch.py`` to the end of the first training step of the demo.

    python -m benchmarks.start.first_step [--against another/checkout] [--rounds 5]

Runs both checkouts alternately, each time in a new process and an empty folder, up to the end of
the first step. Seconds are of all threads of the process, which other programs on the machine
change little. Writes ``benchmarks/results/start.csv``."""

import argparse
import csv
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/start.csv"
COLUMNS = ("checkout", "commit", "round", "stage", "cpu_seconds")


def start_run(checkout: Path, *overrides: str, config: str = "configs/demo.yaml") -> dict[str, Any]:
    """Run a checkout's ``launch.py`` until its first step has ended.

    Args:
        checkout: the folder of ``launch.py``.

    Returns:
        ``ends``: processor seconds at the end of each stage, in order; ``modules``: the names of
        the imported modules.

    Raises:
        RuntimeError: the run failed before.
    """
    with tempfile.TemporaryDirectory() as folder:
        extension = Path(folder, "custom", "first_step")
        extension.mkdir(parents=True)
        shutil.copy(Path(__file__).with_name("probe.py"), extension / "__init__.py")
        command = [sys.executable, checkout / "launch.py", "--config", checkout / config, "--train"]
        done = subprocess.run(
            [*map(str, command), "--gpu", "cpu", *overrides],
            cwd=folder,
            env=os.environ | {"PYTHONPATH": str(checkout)},
            capture_output=True,
            text=True,
        )
    for line in done.stdout.splitlines():
        if line.startswith("FIRST_STEP "):
            return json.loads(line.removeprefix("FIRST_STEP "))
    raise RuntimeError(f"{checkout} made no step:\n{done.stdout}\n{done.stderr}")


def seconds_by_stage(ends: dict[str, float]) -> dict[str, float]:
    """Return the seconds of each stage instead of those at its end."""
    times = [0.0, *ends.values()]
    return {stage: times[i + 1] - times[i] for i, stage in enumerate(ends)}


def commit_of(checkout: Path) -> str:
    command = ["git", "-C", str(checkout), "rev-parse", "--short", "HEAD"]
    return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--against", type=Path, help="another checkout, such as a git worktree")
    parser.add_argument("--rounds", type=int, default=5)
    args = parser.parse_args()
    checkouts = {"before": args.against.resolve()} if args.against else {}
    checkouts["now"] = ROOT
    rows = []
    for number in range(args.rounds):
        for name, checkout in checkouts.items():
            ends = start_run(checkout)["ends"]
            print(f"{name}: {ends['first step']:.2f} CPU s", flush=True)
            place = (name, commit_of(checkout), number)
            rows += [(*place, *stage) for stage in seconds_by_stage(ends).items()]
    write(rows)
    for name in checkouts:
        print(f"{name}: median {median_total(rows, name):.2f} CPU s to the first step")


def write(rows: list[tuple]) -> None:
    with open(RESULTS, "w", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(COLUMNS)
        writer.writerows((*row[:4], f"{row[4]:.3f}") for row in rows)


def median_total(rows: list[tuple], checkout: str) -> float:
    totals: dict[int, float] = {}
    for name, _, number, _, seconds in rows:
        if name == checkout:
            totals[number] = totals.get(number, 0.0) + seconds
    return statistics.median(totals.values())


if __name__ == "__main__":
    main()
