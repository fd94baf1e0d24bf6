"""Fuzz every file reader with damaged files, every rasteriser backend with extreme Gaussians, and
densification and pruning with random sequences of operations.

    python -m benchmarks.robustness.fuzz                      # `make fuzz`: all targets
    python -m benchmarks.robustness.fuzz --only glb checkpoint --inputs 500 --seed 7

Each target runs in a process with a memory limit. If the process reports nothing for a minute, it
is killed and another one continues with the next input. Inputs that failed are kept in ``--keep``
under the target's name, seed and index, from which they can be generated again. Prints a table and
writes ``benchmarks/results/fuzz.csv``. Exit code 1 if anything failed."""

import argparse
import csv
import importlib
import json
import os
import resource
import select
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

ROOT = Path(__file__).resolve().parents[2]

RESULTS = ROOT / "benchmarks/results/fuzz.csv"
TIMEOUT = 60
"""Seconds without a report after which a process counts as hanging; an input has 10."""
STARTUP = 600
"""Seconds until the first report: imports take minutes on a busy machine."""
ROOM = 3 << 30
"""Bytes of address space that a process may add to that of its libraries."""
MODULES = {"rasteriser": "tests.fuzz.scenes", "densify and prune": "tests.fuzz.sequences"}
"""What a target's process imports before it counts as started; others import the file targets."""
UNITS = {"rasteriser": "Gaussians, forward and backward", "densify and prune": "operations"}
OPERATIONS = 25
SEQUENCES_AT_ONCE = 20


class Row(NamedTuple):
    """A row of the table."""

    target: str
    unit: str
    inputs: int
    failures: int
    refused: int
    seconds: float


# ---- in the worker process -----------------------------------------------------------------------

Report = Iterator[tuple[int, dict[str, Any]]]
"""The index of each input, with its results by row name: counts of "inputs" and messages of
"failures".
"""


def try_files(name: str, seed: int, first: int, last: int) -> Report:
    from tests.fuzz.targets import outcomes

    for index, (kind, detail) in outcomes(name, range(first, last), seed):
        failures = [detail] if kind == "failed" else []
        refused = {name: int(kind == "refused")}
        yield index, {"inputs": {name: 1}, "refused": refused, "failures": {name: failures}}


def try_scenes(name: str, seed: int, first: int, last: int) -> Report:
    """Render each scene with every backend, and compare all of them on its well-posed part."""
    import pytest
    import torch

    from tests.fuzz.scenes import disagreement_on, extreme_scene, fault_of, well_posed
    from tests.stability.backends import BACKENDS, cuda_on_the_host

    torch.set_num_threads(1)
    if "cuda" in BACKENDS:
        cuda_on_the_host(pytest.MonkeyPatch())
    for index in range(first, last):
        scene = extreme_scene(seed * 1_000_000 + index)
        part = well_posed(scene)
        checks = {backend: (fault_of, scene, backend) for backend in BACKENDS}
        checks["agreement"] = (disagreement_on, part, BACKENDS)
        seconds, failures = {}, {}
        for row, (check, *arguments) in checks.items():
            started = time.perf_counter()
            failures[row] = _faults(check, *arguments)
            seconds[row] = time.perf_counter() - started
        counts = {row: len(checked.cloud.means) for row, (_, checked, _) in checks.items()}
        yield index, {"inputs": counts, "failures": failures, "seconds": seconds}


def _faults(check: Callable[..., str | None], *arguments: Any) -> list[str]:
    try:
        found = check(*arguments)
    except Exception as error:
        found = f"crash: {type(error).__name__}: {error}"
    return [found] if found else []


def try_sequences(name: str, seed: int, first: int, last: int) -> Report:
    import hypothesis
    import torch
    from hypothesis.stateful import run_state_machine_as_test

    from tests.fuzz.sequences import CloudSequence

    torch.set_num_threads(1)
    settings = hypothesis.settings(
        max_examples=SEQUENCES_AT_ONCE, stateful_step_count=OPERATIONS, deadline=None,
        database=None, suppress_health_check=list(hypothesis.HealthCheck),
    )  # fmt: skip
    for index in range(first, last, SEQUENCES_AT_ONCE):
        CloudSequence.steps, failures = 0, []
        seeded = hypothesis.seed(seed * 1_000_000 + index)(CloudSequence)
        try:
            run_state_machine_as_test(seeded, settings=settings)
        except Exception as error:
            failures.append(f"{type(error).__name__}: {error}")
        yield index, {"inputs": {name: CloudSequence.steps}, "failures": {name: failures}}


def work(name: str, seed: int, first: int, last: int) -> None:
    """Try the inputs ``first`` to ``last``; print the results of each as a line of JSON."""
    output = os.fdopen(os.dup(1), "w", buffering=1)
    nothing = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nothing, 1)
    os.dup2(nothing, 2)
    importlib.import_module(MODULES.get(name, "tests.fuzz.targets"))
    report = kind_of(name)(name, seed, first, last)
    print(json.dumps({"ready": True}), file=output)
    if Path("/proc/self/statm").exists():
        pages = int(Path("/proc/self/statm").read_text().split()[0])
        libraries = pages * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (libraries + ROOM, resource.RLIM_INFINITY))
    for index, counts in report:
        print(json.dumps({"index": index, **counts}), file=output)


def kind_of(name: str) -> Callable[[str, int, int, int], Report]:
    return {"rasteriser": try_scenes, "densify and prune": try_sequences}.get(name, try_files)


# ---- in the main process -------------------------------------------------------------------------


Enough = Callable[["TargetRun"], bool]


class TargetRun:
    """One target's worker processes, one after the other, and the sums of their reports."""

    def __init__(self, name: str, seed: int, keep: Path) -> None:
        self.name, self.seed, self.keep = name, seed, keep
        self.sums: dict[str, dict[str, Any]] = {
            kind: {} for kind in ("inputs", "refused", "failures", "seconds")
        }
        self.at_once = SEQUENCES_AT_ONCE if name == "densify and prune" else 1

    def run(self, count: int, enough: Enough, tick: Callable[[int], None]) -> None:
        """Try inputs 0 to ``count``, or until there are enough; a process that ends early is
        followed by another one.
        """
        first, started = 0, time.perf_counter()
        while first < count and not enough(self):
            first = self._watch(first, count, enough, tick)
        self.sums["seconds"].setdefault(self.name, time.perf_counter() - started)

    def _watch(self, first: int, count: int, enough: Enough, tick: Callable[[int], None]) -> int:
        """Return the index to continue with."""
        worker = ["--worker", self.name, str(self.seed), str(first), str(count)]
        command = [sys.executable, "-m", __spec__.name, *worker]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        timeout = STARTUP
        try:
            while not enough(self):
                ready = select.select([process.stdout], [], [], timeout)[0]
                line, timeout = process.stdout.readline() if ready else "hang", TIMEOUT
                if line == "" and process.wait() == 0:
                    return count
                if line in ("", "hang"):
                    return self._lost(first, line, process, tick)
                report = json.loads(line)
                if "index" in report:
                    self._add(report)
                    tick(report["index"] + 1 - first)
                    first = report["index"] + self.at_once
            return count
        finally:
            process.kill()
            process.wait()

    def _lost(
        self, index: int, line: str, process: subprocess.Popen, tick: Callable[[int], None]
    ) -> int:
        problem = (
            f"no report for {TIMEOUT} s" if line else f"the process ended with {process.returncode}"
        )
        self._add({"index": index, "inputs": {self.name: 1}, "failures": {self.name: [problem]}})
        tick(1)
        return index + 1

    def _add(self, report: dict[str, Any]) -> None:
        for row, failures in report["failures"].items():
            for failure in failures:
                print(f"{row} {report['index']}: {failure}", file=sys.stderr)
                self._keep(report["index"], failure)
        counts = {row: len(failures) for row, failures in report["failures"].items()}
        for kind, sums in self.sums.items():
            for row, value in (report | {"failures": counts}).get(kind, {}).items():
                sums[row] = sums.get(row, 0) + value

    def _keep(self, index: int, failure: str) -> None:
        self.keep.mkdir(parents=True, exist_ok=True)
        name = self.keep / f"{self.name.replace(' ', '-')}-{self.seed}-{index}"
        name.with_suffix(".txt").write_text(failure + "\n")
        if kind_of(self.name) is try_files:
            from tests.fuzz.targets import TARGETS, mutant

            name.with_suffix(TARGETS[self.name].suffix).write_bytes(
                mutant(self.name, self.seed, index)
            )

    def rows(self) -> list[Row]:
        unit = UNITS.get(self.name, "damaged files")
        prefix = f"{self.name}: " if self.name == "rasteriser" else ""
        return [
            Row(
                f"{prefix}{row}", unit, inputs, self.sums["failures"].get(row, 0),
                self.sums["refused"].get(row, 0), self.sums["seconds"][row],
            )
            for row, inputs in self.sums["inputs"].items()
        ]  # fmt: skip


# ---- the table -----------------------------------------------------------------------------------


def main() -> int:
    options = parse()
    from tqdm import tqdm

    rows, names = [], options.only or [*file_targets(), "rasteriser", "densify and prune"]
    for name in names:
        target, count = TargetRun(name, options.seed, Path(options.keep)), how_many(name, options)
        total = None if name == "rasteriser" else count
        with tqdm(desc=name, total=total, unit="input", disable=None) as bar:
            target.run(count, enough_of(name, options), bar.update)
        rows += target.rows()
        print("\n".join(map(line_of, target.rows())), flush=True)
        write(target.rows(), options.seed)
    return int(any(row.failures for row in rows))


def parse() -> argparse.Namespace:
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=raw)
    add = parser.add_argument
    add("--inputs", type=int, default=2500, help="damaged files of each kind")
    extreme = "extreme Gaussians through each backend; 'agreement' has fewer"
    add("--gaussians", type=int, default=1_000_000, help=extreme)
    sequences = f"random sequences of at most {OPERATIONS} operations"
    add("--sequences", type=int, default=1000, help=sequences)
    add("--seed", type=int, default=0)
    add("--only", nargs="+", help="only these targets; other rows of the CSV are kept")
    add("--keep", default="outputs/fuzz-failures", help="folder for inputs that failed")
    add("--worker", nargs=4, help=argparse.SUPPRESS)
    return parser.parse_args()


def file_targets() -> list[str]:
    from tests.fuzz.targets import TARGETS

    return list(TARGETS)


def enough_of(name: str, options: argparse.Namespace) -> Enough:
    """Return whether a target is done early: scenes, when every backend has had its Gaussians."""

    def enough(target: TargetRun) -> bool:
        drawn = [count for row, count in target.sums["inputs"].items() if row != "agreement"]
        return name == "rasteriser" and min(drawn, default=0) >= options.gaussians

    return enough


def how_many(name: str, options: argparse.Namespace) -> int:
    return {"rasteriser": options.gaussians // 100, "densify and prune": options.sequences}.get(
        name, options.inputs
    )


def line_of(row: Row) -> str:
    return (
        f"{row.target:24} {row.inputs:>11,} {row.unit:32} {row.failures:4} failures "
        f"{row.refused:6} refused {row.seconds:8.1f} s"
    )


def write(rows: list[Row], seed: int) -> None:
    """Replace the rows of these targets in the CSV."""
    from benchmarks.splatting.bench_splatting import describe_machine

    device, _, commit = describe_machine().rpartition("; commit ")
    table: dict[str, list] = {}
    if RESULTS.exists():
        with RESULTS.open(newline="") as file:
            table = {row[0]: row for row in list(csv.reader(file))[1:]}
    table |= {
        row.target: [*row._replace(seconds=round(row.seconds, 1)), seed, commit, device]
        for row in rows
    }
    with RESULTS.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow([*Row._fields, "seed", "commit", "device"])
        writer.writerows(table.values())


if __name__ == "__main__":
    if "--worker" in sys.argv:
        name, seed, first, last = parse().worker
        work(name, int(seed), int(first), int(last))
    else:
        sys.exit(main())
