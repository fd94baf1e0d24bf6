"""The measured parts of starts and steps in reports/speed.md."""

import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import grouped

FOLDER = Path(__file__).resolve().parents[1] / "results"
RESULTS = FOLDER / "start.csv"
NOT_THE_REST = ("rasteriser", "network", "optimiser")
LOGS, REST = "logs and progress bar", "**all but rasteriser, network, optimiser**"
BOUNDS = {LOGS: 0.02, REST: 0.25}
"""Largest shares of a step that parts are to have."""
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


def step_parts() -> str:
    """Return the median milliseconds of a step's parts, their shares of the step, and whether they
    are within BOUNDS.
    """
    rows = read(FOLDER / "step.csv")
    columns = grouped(
        rows, lambda row: tuple(row[key] for key in ("workload", "steps", "checkout"))
    )
    head = [
        f"{workload}, steps {steps}, {checkout} ({_commits(own)})"
        for (workload, steps, checkout), own in columns.items()
    ]
    medians = [_medians(own) for own in columns.values()]
    parts = {part: [part] for part in medians[0]}
    parts[REST] = [part for part in parts if part not in NOT_THE_REST]
    lines = [
        (_with_bound(title), *(_with_share(found, names, title) for found in medians))
        for title, names in parts.items()
    ]
    lines.append(("all", *(f"{sum(found.values()):.1f}" for found in medians)))
    table = markdown(("processor ms of a step", *head), lines)
    return f"{table}\n\n{_processors(rows)}"


def _medians(rows: Rows) -> dict[str, float]:
    """Return the median milliseconds of each part."""
    by_part = grouped(rows, lambda row: row["part"])
    return {
        part: statistics.median(float(row["cpu_ms"]) for row in same)
        for part, same in by_part.items()
    }


def _with_bound(title: str) -> str:
    return f"{title}, at most {BOUNDS[title]:.0%}".replace("%", " %") if title in BOUNDS else title


def _with_share(medians: dict[str, float], parts: list[str], title: str) -> str:
    milliseconds = sum(medians[part] for part in parts)
    share = milliseconds / sum(medians.values())
    cell = f"{milliseconds:.1f} ({share:.1%})".replace("%", " %")
    if title not in BOUNDS:
        return cell
    return f"{cell}: {'met' if share <= BOUNDS[title] else 'missed'}"


def _unique(values: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(values))
