"""The measured part of docs/step_time.md about the start, from benchmarks/results/start.csv."""

import statistics
from pathlib import Path

from benchmarks.markdown import markdown, read

RESULTS = Path(__file__).resolve().parents[1] / "results/start.csv"


def first_step() -> str:
    """Return the median processor seconds of each stage up to the first step, and their sum."""
    rows = read(RESULTS)
    checkouts = list(dict.fromkeys(row["checkout"] for row in rows))
    stages = list(dict.fromkeys(row["stage"] for row in rows))
    medians = {
        (name, stage): statistics.median(
            float(row["cpu_seconds"])
            for row in rows
            if (row["checkout"], row["stage"]) == (name, stage)
        )
        for name in checkouts
        for stage in stages
    }
    head = ("stage", *(_heading(rows, name) for name in checkouts))
    table = [(stage, *(f"{medians[name, stage]:.2f}" for name in checkouts)) for stage in stages]
    sums = [sum(medians[name, stage] for stage in stages) for name in checkouts]
    return markdown(head, [*table, ("all", *(f"{total:.2f}" for total in sums))])


def _heading(rows: list[dict[str, str]], checkout: str) -> str:
    (commit,) = {row["commit"] for row in rows if row["checkout"] == checkout}
    return f"{checkout} ({commit}), CPU s"
