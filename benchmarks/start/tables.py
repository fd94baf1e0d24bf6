"""The measured parts of docs/step_time.md, the seconds of conversions in docs/mesh.md, and those of
whole runs in docs/toybox.md.
"""

import statistics
from collections.abc import Iterable
from pathlib import Path
from typing import TypeVar

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import grouped
from benchmarks.start.import_times import STANDARD

FOLDER = Path(__file__).resolve().parents[1] / "results"
RESULTS = FOLDER / "start.csv"
NOT_THE_REST = ("rasteriser", "network", "optimiser")
LOGS, REST = "logs and progress bar", "**all but rasteriser, network, optimiser**"
BOUNDS = {LOGS: 0.02, REST: 0.25}
"""Largest shares of a step that parts are to have."""
SHOWN_SHARE = 0.01
"""Smallest share of a package in the table of imports."""
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


def imports() -> str:
    """Return the median milliseconds of the packages that a run imports before its first step."""
    rows = read(FOLDER / "imports.csv")
    columns = ("own_ms", "cumulative_ms")
    medians = {
        package: [statistics.median(float(row[name]) for row in same) for name in columns]
        for package, same in grouped(rows, lambda row: row["package"]).items()
    }
    total = sum(own for own, _ in medians.values())
    shown = {name: both for name, both in medians.items() if both[1] >= SHOWN_SHARE * total}
    lines = [
        (f"`{name}`" if name != STANDARD else name, *(_ms_with_share(ms, total) for ms in both))
        for name, both in sorted(shown.items(), key=lambda item: -item[1][1])
    ]
    others = total - sum(own for own, _ in shown.values())
    lines.append((f"{len(medians) - len(shown)} others", _ms_with_share(others, total), ""))
    lines.append(("all", f"{total:.0f}", ""))
    head = (f"package ({_commits(rows)})", "own modules, ms", "with their imports, ms")
    return f"{markdown(head, lines)}\n\n{_processors(rows)}"


def _ms_with_share(milliseconds: float, total: float) -> str:
    return f"{milliseconds:.0f} ({milliseconds / total:.0%})".replace("%", " %")


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
