"""Processor seconds from ``launch.py`` to the end of the first training step of the demo.

    python -m benchmarks.start.first_step [--against another/checkout] [--rounds 5]

Runs both checkouts alternately, each time in a new process and an empty folder, up to the end of
the first step. Seconds are of all threads of the process, which other programs on the machine
change little. Writes ``benchmarks/results/start.csv``."""

import statistics
from pathlib import Path

from benchmarks.markdown import write_rows
from benchmarks.quality.runs import machine
from benchmarks.start.launched import ROOT, checkouts_of, commit_of, paired_parser, run_with_probe

RESULTS = ROOT / "benchmarks/results/start.csv"
PROBE = Path(__file__).with_name("probe.py")
COLUMNS = ("checkout", "commit", "machine", "round", "stage", "cpu_seconds")


def seconds_by_stage(ends: dict[str, float]) -> dict[str, float]:
    """Return the seconds of each stage instead of those at its end."""
    times = [0.0, *ends.values()]
    return {stage: times[i + 1] - times[i] for i, stage in enumerate(ends)}


def main() -> None:
    parser = paired_parser(__doc__, rounds=5)
    args = parser.parse_args()
    checkouts = checkouts_of(args.against)
    rows = []
    for number in range(args.rounds):
        for name, checkout in checkouts.items():
            ends = run_with_probe(PROBE, checkout)["ends"]
            print(f"{name}: {ends['first step']:.2f} CPU s", flush=True)
            place = (name, commit_of(checkout), machine(), number)
            rows += [(*place, *stage) for stage in seconds_by_stage(ends).items()]
    write_rows(RESULTS, COLUMNS, ((*place, f"{seconds:.3f}") for *place, seconds in rows))
    for name in checkouts:
        print(f"{name}: median {median_total(rows, name):.2f} CPU s to the first step")


def median_total(rows: list[tuple], checkout: str) -> float:
    totals: dict[int, float] = {}
    for name, _, _, number, _, seconds in rows:
        if name == checkout:
            totals[number] = totals.get(number, 0.0) + seconds
    return statistics.median(totals.values())


if __name__ == "__main__":
    main()
