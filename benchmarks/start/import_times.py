"""Which packages the imports of a run consist of, up to the end of its first training step.

    python -m benchmarks.start.import_times [--rounds 3]

Runs the demo with ``PYTHONPROFILEIMPORTTIME``, as ``python -X importtime`` does, each time in a new
process with one thread. Writes ``benchmarks/results/imports.csv``: milliseconds of the clock, which
other programs on the machine make longer, so compare shares."""

import argparse
import re
import sys
from collections import defaultdict
from collections.abc import Iterable

from benchmarks.markdown import write_rows
from benchmarks.quality.runs import machine
from benchmarks.start.first_step import PROBE
from benchmarks.start.launched import ROOT, commit_of, launch_with_probe
from benchmarks.start.step_shares import THREADS

RESULTS = ROOT / "benchmarks/results/imports.csv"
COLUMNS = ("commit", "machine", "round", "package", "own_ms", "cumulative_ms")
LINE = re.compile(r"import time: +(\d+) \| +(\d+) \| ( *)(\S+)")
"""Of a module: own and cumulative microseconds, two spaces per module that imports it, and name."""
STANDARD = "standard library"


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=3)
    rows = []
    for number in range(parser.parse_args().rounds):
        environment = THREADS | {"PYTHONPROFILEIMPORTTIME": "1"}
        done = launch_with_probe(PROBE, ROOT, environment=environment)
        times = by_package(done.stderr.splitlines())
        print(f"round {number}: {sum(own for own, _ in times.values()):.0f} ms", flush=True)
        place = (commit_of(ROOT), machine(), number)
        rows += [(*place, name, *(f"{ms:.1f}" for ms in both)) for name, both in times.items()]
    write_rows(RESULTS, COLUMNS, rows)


def by_package(lines: Iterable[str]) -> dict[str, tuple[float, float]]:
    """Return milliseconds of each package: those of its own modules, and those with all that these
    were the first to import.

    Args:
        lines: as Python prints them, a module after those that it imports.
    """
    own: dict[str, float] = defaultdict(float)
    cumulative: dict[str, float] = defaultdict(float)
    importers: list[str] = []
    for line in reversed(list(lines)):
        if found := LINE.fullmatch(line.rstrip()):
            package = package_of(found[4])
            del importers[len(found[3]) // 2 :]
            own[package] += int(found[1]) / 1000
            if package not in importers:
                cumulative[package] += int(found[2]) / 1000
            importers.append(package)
    return {name: (own[name], cumulative[name]) for name in own}


def package_of(module: str) -> str:
    """Return a module's package, or :data:`STANDARD`."""
    name = module.partition(".")[0]
    return STANDARD if name in sys.stdlib_module_names else name


if __name__ == "__main__":
    main()
