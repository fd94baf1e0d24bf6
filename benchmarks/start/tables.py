"""The measured parts of docs/step_time.md, the seconds of conversions in docs/mesh.md, and those of
whole runs in docs/toybox.md.
"""

import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import grouped

FOLDER = Path(__file__).resolve().parents[1] / "results"
RESULTS = FOLDER / "start.csv"
NOT_THE_REST = ("rasteriser", "score", "optimiser")
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
    return markdown(head, [*table, ("all", *(f"{total:.2f}" for total in sums))])


def whole_runs() -> str:
    """Return median seconds and memory of whole runs with the small learned models."""
    rows = read(FOLDER / "whole_run.csv")
    numbers = ("seconds", "prior_seconds", "cpu_seconds", "peak_mb")
    lines = []
    groups = grouped(rows, lambda row: (row["configuration"], _place(row)))
    for (name, place), same in groups.items():
        medians = [statistics.median(float(row[number]) for row in same) for number in numbers]
        lines.append((name, place, str(len(same)), *(f"{value:.0f}" for value in medians)))
    head = ("configuration", "cores", "runs", "seconds", "until the prior's points", "CPU seconds")
    return markdown((*head, "peak memory, MB"), lines)


def _place(row: dict[str, str]) -> str:
    return f"{row['cores']}, {row['machine']}"


def _heading(rows: Rows, checkout: str) -> str:
    (commit,) = {row["commit"] for row in rows if row["checkout"] == checkout}
    return f"{checkout} ({commit}), CPU s"


def step_parts() -> str:
    """Return the median milliseconds of a step's parts, and their shares of the step now."""
    rows = read(FOLDER / "step.csv")
    pairs = _unique((row["workload"], row["checkout"]) for row in rows)
    medians = {pair: _medians(rows, pair) for pair in pairs}
    head = ("processor ms of a step", *(f"{name}, {checkout}" for name, checkout in pairs))
    parts = list(medians[pairs[0]])
    cells = {part: [_with_share(medians[pair], [part]) for pair in pairs] for part in parts}
    rest = [part for part in parts if part not in NOT_THE_REST]
    cells["**all but rasteriser, score, optimiser**"] = [
        _with_share(medians[pair], rest) for pair in pairs
    ]
    cells["all"] = [f"{sum(medians[pair].values()):.1f}" for pair in pairs]
    return markdown(head, [(part, *values) for part, values in cells.items()])


def _medians(rows: Rows, pair: tuple[str, str]) -> dict[str, float]:
    """Return the median milliseconds of each part, for a workload and a checkout."""
    own = [row for row in rows if (row["workload"], row["checkout"]) == pair]
    return {
        part: statistics.median(float(row["cpu_ms"]) for row in own if row["part"] == part)
        for part in _unique(row["part"] for row in own)
    }


def _with_share(medians: dict[str, float], parts: list[str]) -> str:
    milliseconds = sum(medians[part] for part in parts)
    return f"{milliseconds:.1f} ({milliseconds / sum(medians.values()):.0%})".replace("%", " %")


def demo_stages() -> str:
    """Return the seconds of each stage of the demos, from an empty clone."""
    rows = read(FOLDER / "demo_stages.csv")
    targets, stages = (_unique(row[key] for row in rows) for key in ("target", "stage"))
    found = {(row["target"], row["stage"]): row for row in rows}
    numbers = [(target, name) for target in targets for name in ("seconds", "cpu_seconds")]
    lines = []
    for stage in stages:
        own = [(found.get((target, stage)), name) for target, name in numbers]
        lines.append((stage, *(f"{float(row[name]):.1f}" if row else "" for row, name in own)))
    whole = [row for row in rows if not row["stage"].startswith("of it")]
    sums = [sum(float(r[name]) for r in whole if r["target"] == t) for t, name in numbers]
    head = [f"make {t}, {name.replace('cpu_', 'CPU ')}" for t, name in numbers]
    return markdown(("stage", *head), [*lines, ("all", *(f"{total:.0f}" for total in sums))])


def conversion() -> str:
    """Return the median processor seconds of ``convert cloud.ply object.glb`` per object."""
    rows = read(FOLDER / "convert.csv")
    objects, checkouts = (_unique(row[key] for row in rows) for key in ("object", "checkout"))
    table = [
        (name, *(f"{_seconds_of(rows, name, checkout):.1f}" for checkout in checkouts))
        for name in objects
    ]
    return markdown(("object", *(_heading(rows, name) for name in checkouts)), table)


def _seconds_of(rows: Rows, name: str, checkout: str) -> float:
    own = (row for row in rows if (row["object"], row["checkout"]) == (name, checkout))
    return statistics.median(float(row["cpu_seconds"]) for row in own)


def _unique(values: Iterable[T]) -> list[T]:
    return list(dict.fromkeys(values))
