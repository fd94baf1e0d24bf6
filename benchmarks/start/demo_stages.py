"""Seconds per stage of ``make demo-exact`` from an empty clone, installation included.

    python -m benchmarks.start.demo_stages [--folder empty/folder]

Clones this repository's HEAD, and runs the steps of ``make demo-exact`` in turn: virtual
environment, installation of the dependencies and of the package, the demo. Compiling the kernels is
timed once more on its own. Needs a package index; pip's cache isn't used. Writes
``benchmarks/results/demo_stages.csv``: seconds of the clock, which other programs on the machine
make longer, and processor seconds of all threads and child processes."""

import argparse
import csv
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.start.convert_time import children_seconds
from benchmarks.start.launched import MARK, commit_of

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/demo_stages.csv"
PROBE = Path(__file__).with_name("demo_probe.py")
COLUMNS = ("commit", "stage", "seconds", "cpu_seconds")
WITHOUT_CACHE = {"PIP_NO_CACHE_DIR": "1"}
Row = tuple[str, float, float]
"""A stage, its seconds, and its processor seconds."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--folder", type=Path, help="where to clone; default: a temporary folder")
    args = parser.parse_args()
    commit = commit_of(ROOT)
    with tempfile.TemporaryDirectory(dir=args.folder) as folder:
        found = []
        for row in stages(Path(folder) / "clone"):
            print(f"{row[0]}: {row[1]:.1f} s, {row[2]:.1f} CPU s", flush=True)
            found.append((commit, row[0], f"{row[1]:.2f}", f"{row[2]:.2f}"))
    with open(RESULTS, "w", newline="") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *found])


def stages(clone: Path) -> Iterator[Row]:
    """Run all stages of the demo in a new folder ``clone``."""
    yield timed("clone", ["git", "clone", "--quiet", str(ROOT), str(clone)], clone.parent)[0]
    yield timed("virtual environment", ["make", ".venv/bin/python"], clone)[0]
    yield timed("installation, kernels included", ["make", ".venv/ready"], clone)[0]
    yield timed("of it: compile the kernels", compiling(clone), clone)[0]
    extension = clone / "custom/probe"
    extension.mkdir(parents=True)
    shutil.copy(PROBE, extension / "__init__.py")
    started = time.time()
    _, output = timed("demo", ["make", "demo-exact"], clone)
    (line,) = (line for line in output.splitlines() if line.startswith(MARK))
    yield from differences(json.loads(line.removeprefix(MARK)), started)


def compiling(clone: Path) -> list[str]:
    """Return the command that compiles the kernels into another folder."""
    folders = ["--build-temp", str(clone / "again"), "--build-lib", str(clone / "again")]
    return [str(clone / ".venv/bin/python"), "setup.py", "--quiet", "build_ext", *folders]


def timed(stage: str, command: list[str], folder: Path) -> tuple[Row, str]:
    """Run a command; return its row and its output.

    Raises:
        RuntimeError: it failed.
    """
    began, before = time.perf_counter(), children_seconds()
    done = subprocess.run(
        command, cwd=folder, env=os.environ | WITHOUT_CACHE, capture_output=True, text=True
    )
    if done.returncode:
        raise RuntimeError(f"{command} failed:\n{done.stdout[-2000:]}\n{done.stderr[-2000:]}")
    return (stage, time.perf_counter() - began, children_seconds() - before), done.stdout


def differences(ends: dict[str, tuple[float, float]], started: float) -> Iterator[Row]:
    """Yield the stages of the demo, given what the clocks showed at the end of each."""
    earlier = (0.0, started)
    for stage, (processor, clock) in ends.items():
        yield stage, clock - earlier[1], processor - earlier[0]
        earlier = processor, clock


if __name__ == "__main__":
    main()
