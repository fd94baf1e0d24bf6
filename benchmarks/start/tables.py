"""The measured part of starts in reports/speed.md."""

import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from benchmarks.markdown import markdown, read

FOLDER = Path(__file__).resolve().parents[1] / "results"
RESULTS = FOLDER / "start.csv"
T = TypeVar("T")
Rows = list[dict[str, str]]


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
    table = markdown(head, [*table, ("all", *(f"{total:.2f}" for total in sums))])
    return f"{table}\n\n{_processors(rows)}"


def _heading(rows: Rows, checkout: str) -> str:
    return f"{checkout} ({_commits(row for row in rows if row['checkout'] == checkout)}), CPU s"


def _commits(rows: Iterable[dict[str, str]]) -> str:
    return ", ".join(_unique(row["commit"] for row in rows))


def _processors(rows: Rows) -> str:
    return f"Processor: {', '.join(_unique(row['machine'] for row in rows))}."


def _unique(values: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(values))
