"""Seconds per stage of ``make demo`` and ``make demo-exact`` from an empty clone.

    python -m benchmarks.start.demo_stages [--targets demo demo-exact] [--folder empty/folder]

Clones this repository's HEAD for each target and runs its steps in turn: virtual environment,
installation of the dependencies and of the package, the demo. Compiling the kernels is timed once
more on its own. ``make demo`` trains each prompt in a process of its own: their stages are added.
Needs a package index; pip's cache isn't used. Replaces the rows of the targets in
``benchmarks/results/demo_stages.csv``: seconds of the clock, which other programs on the machine
make longer, and processor seconds of all threads and child processes."""

import argparse
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from benchmarks.markdown import read, write
from benchmarks.start.convert_time import children_seconds
from benchmarks.start.launched import MARK, commit_of

ROOT = Path(__file__).resolve().parents[2]
RESULTS = ROOT / "benchmarks/results/demo_stages.csv"
PROBE = Path(__file__).with_name("demo_probe.py")
COLUMNS = ("target", "commit", "stage", "seconds", "cpu_seconds")
TARGETS = {"demo": ".venv/ready-for-models", "demo-exact": ".venv/ready"}
"""The targets of the Makefile, and what each of them installs."""
WITHOUT_CACHE = {"PIP_NO_CACHE_DIR": "1"}
Row = tuple[str, float, float]
"""A stage, its seconds, and its processor seconds."""


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--targets", nargs="+", choices=TARGETS, default=[*TARGETS])
    parser.add_argument("--folder", type=Path, help="where to clone; default: a temporary folder")
    args = parser.parse_args()
    commit = commit_of(ROOT)
    earlier = read(RESULTS) if RESULTS.is_file() else []
    rows = [row for row in earlier if row["target"] not in args.targets]
    for target in args.targets:
        with tempfile.TemporaryDirectory(dir=args.folder) as folder:
            for stage, seconds, cpu in stages(Path(folder) / "clone", target):
                print(f"{target}, {stage}: {seconds:.1f} s, {cpu:.1f} CPU s", flush=True)
                values = (target, commit, stage, f"{seconds:.2f}", f"{cpu:.2f}")
                rows.append(dict(zip(COLUMNS, values, strict=True)))
    write(RESULTS, COLUMNS, rows)


def stages(clone: Path, target: str) -> Iterator[Row]:
    """Run all stages of a target in a new folder ``clone``."""
    yield timed("clone", ["git", "clone", "--quiet", str(ROOT), str(clone)], clone.parent)[0]
    yield timed("virtual environment", ["make", ".venv/bin/python"], clone)[0]
    yield timed("installation, kernels included", ["make", TARGETS[target]], clone)[0]
    yield timed("of it: compile the kernels", compiling(clone), clone)[0]
    extension = clone / "custom/probe"
    extension.mkdir(parents=True)
    shutil.copy(PROBE, extension / "__init__.py")
    started = time.time()
    demo, output = timed("demo", ["make", target], clone)
    yield from stages_of_demo(output, started, demo)


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


def stages_of_demo(output: str, started: float, demo: Row) -> Iterator[Row]:
    """Yield the stages of the demo's runs, added over the runs, and what follows them.

    Args:
        output: what the demo printed, with a line of ``demo_probe.py`` for each run.
        started: time of day at its start.
        demo: the whole of it.
    """
    sums: dict[str, tuple[float, float]] = {}
    end = started
    for line in output.splitlines():
        if line.startswith(MARK):
            spent = 0.0  # each run is a process of its own
            for stage, (processor, clock) in json.loads(line.removeprefix(MARK)).items():
                seconds, cpu = sums.get(stage, (0.0, 0.0))
                sums[stage] = seconds + clock - end, cpu + processor - spent
                spent, end = processor, clock
    yield from ((stage, *both) for stage, both in sums.items())
    _, seconds, cpu = demo
    yield "after the runs", started + seconds - end, cpu - sum(both[1] for both in sums.values())


if __name__ == "__main__":
    main()
