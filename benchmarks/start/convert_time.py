"""Processor seconds of ``convert cloud.ply object.glb``, the program's start included.

    python -m benchmarks.start.convert_time toy=cloud.ply [spot=...] [--against another/checkout]

Converts each cloud with both checkouts alternately, each time in a new process with one thread.
Seconds are of all threads of the process: on a machine with nothing else to do the command takes
less time than that. Writes ``benchmarks/results/convert.csv``."""

import os
import resource
import subprocess
import sys
import tempfile
from pathlib import Path

from benchmarks.markdown import write_rows
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser
from benchmarks.start.step_shares import THREADS

RESULTS = ROOT / "benchmarks/results/convert.csv"
COLUMNS = ("object", "checkout", "commit", "round", "cpu_seconds")


def main() -> None:
    parser = paired_parser(__doc__, rounds=3)
    parser.add_argument("clouds", nargs="+", metavar="NAME=PATH", help="trained clouds")
    args = parser.parse_args()
    checkouts = checkouts_of(args.against)
    rows = []
    for number in range(args.rounds):
        for name, _, path in (cloud.partition("=") for cloud in args.clouds):
            for checkout, folder in checkouts.items():
                seconds = converted(folder, Path(path).resolve())
                print(f"{name}, {checkout}: {seconds:.2f} CPU s", flush=True)
                rows.append((name, checkout, commit_of(folder), number, f"{seconds:.3f}"))
    write_rows(RESULTS, COLUMNS, rows)


def converted(checkout: Path, cloud: Path) -> float:
    """Return the processor seconds of a checkout's command."""
    environment = os.environ | THREADS | {"PYTHONPATH": str(checkout)}
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "threestudio_gaussiandreamer.convert"]
        before = children_seconds()
        subprocess.run(
            [*command, str(cloud), "object.glb"],
            cwd=folder,
            env=environment,
            check=True,
            capture_output=True,
        )
        return children_seconds() - before


def children_seconds() -> float:
    """Return the processor seconds of all ended child processes."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


if __name__ == "__main__":
    main()
