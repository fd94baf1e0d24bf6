"""Turns what the rows measured (``pytest tests/stability --stability-report FILE``) into
docs/stability.md.

python -m tests.stability.report FILE docs/stability.md
"""

import csv
import json
import sys
from collections.abc import Iterable
from pathlib import Path

from tests.stability.rows import GROUPS, ROWS, Row

GUARDS = Path(__file__).parents[2] / "benchmarks/results/guards.csv"
INTRO = """# Where methods fail, and what happens here

*Made by `make stability` from the run of `tests/stability/`; don't edit it by hand.*

Every row is a way in which text-to-3D with Gaussians, or the software around it, is known to fail:
faults read in the code of others (A0), failures reported in their issues and papers, and limits of
the method itself (A1 to A5). Each has a test that provokes it on a CPU, offline and seeded, and
holds ours to the bar in the table. The tests of A0 also run against an emulation of the fault, a
few lines in our own words that show it, and must fail there: the column says how far off it is. Of
several backends (the kernel, plain torch, the specification), sizes and seeds a row shows the
worst. Rasterisers are judged in float32 against the same formula in float64 unless a test says
otherwise.
"""


def main(source: str, target: str) -> None:
    results = json.loads(Path(source).read_text())
    by_row = {key: [x for x in results if (x["group"], x["name"]) == key] for key in ROWS}
    parts = [
        INTRO,
        summary(by_row),
        *(section(group, by_row) for group in GROUPS),
        cost_of_guards(),
    ]
    Path(target).write_text("\n".join(parts))


def summary(by_row: dict[tuple[str, str], list[dict]]) -> str:
    held = sum(
        bool(tests) and all(test["outcome"] == "passed" for test in tests)
        for tests in by_row.values()
    )
    counts = [f"{len(by_row)} rows, {held} hold"]
    absent = [f"{group} {name}" for (group, name), tests in by_row.items() if not tests]
    if absent:
        counts.append(f"not run: {', '.join(absent)}")
    return "; ".join(counts) + ".\n"


def section(group: str, by_row: dict[tuple[str, str], list[dict]]) -> str:
    rows = [row for row in ROWS.values() if row.group == group]
    faults = group == "A0"
    heads = [
        "Row",
        "Bar",
        "Measured",
        *(["Emulated fault"] if faults else []),
        "Test",
        "What the peers do",
    ]
    lines = [f"## {group} {GROUPS[group]}", "", table_line(heads), table_line(["---"] * len(heads))]
    for row in rows:
        tests = by_row[group, row.name]
        changed = " *(changed, see below)*" if any(test["changed_bar"] for test in tests) else ""
        cells = [
            f"**{row.name}** {row.title}" if row.title else row.name,
            row.bar + changed,
            outcome(tests),
        ]
        lines.append(
            table_line(
                [
                    *cells,
                    *([worst_of(tests, "emulation")] if faults else []),
                    places(tests),
                    row.peers,
                ]
            )
        )
    return "\n".join([*lines, "", *changed_bars(rows, by_row)])


def table_line(cells: Iterable[str]) -> str:
    return f"| {' | '.join(cell.replace('|', chr(92) + '|') for cell in cells)} |"


def outcome(tests: list[dict]) -> str:
    """The worst values, and first of all whether the bar holds."""
    if not tests:
        return "**not run**"
    failed = sorted({test["test"] for test in tests if test["outcome"] != "passed"})
    return (f"**fails** ({', '.join(failed)}): " if failed else "") + worst_of(tests, "measured")


def worst_of(tests: list[dict], kind: str) -> str:
    """One figure of each name and unit, and what was said in words."""
    groups: dict[tuple, list] = {}
    for entry in (entry for test in tests for entry in test[kind]):
        words = isinstance(entry["value"], str)
        groups.setdefault(
            (entry["what"], entry["unit"], entry["worst"], entry["value"] if words else ""), []
        ).append(entry["value"])
    texts = []
    for (what, unit, worst, words), values in groups.items():
        value = words or f"{min(values) if worst == 'min' else max(values):.3g}"
        texts.append(" ".join(part for part in (what, value, unit) if part))
    return "; ".join(dict.fromkeys(texts))


def places(tests: list[dict]) -> str:
    names = dict.fromkeys((test["file"], test["test"]) for test in tests)
    return ", ".join(f"`{file.removesuffix('.py')}::{name}`" for file, name in names)


def changed_bars(rows: list[Row], by_row: dict[tuple[str, str], list[dict]]) -> list[str]:
    """Where a bar couldn't be right: the one that a test holds instead, and the proof, its
    docstring.
    """
    changed = {
        (row.name, test["test"]): test
        for row in rows
        for test in by_row[row.group, row.name]
        if test["changed_bar"]
    }
    if not changed:
        return []
    items = [
        f"* {name} (`{test}`): **{entry['changed_bar']}**. {' '.join(entry['reason'].split())}"
        for (name, test), entry in changed.items()
    ]
    return ["Bars that were changed, and why:", "", *items, ""]


def cost_of_guards() -> str:
    """The figures of ``benchmarks/robustness/bench_guards.py``, which times what no test may."""
    rows = list(csv.DictReader(GUARDS.open()))
    where = (
        "{gaussians} Gaussians, {views} views of {size} x {size} pixels, {threads} threads".format(
            **rows[0]
        )
    )
    lines = [
        "## What the guards cost",
        "",
        f"Measured by `benchmarks/robustness/bench_guards.py`: {where}. The bar is 2 %.",
        "",
    ]
    lines += [table_line(["Guard", "ms", "of ms", "%"]), table_line(["---"] * 4)]
    figures = [
        (row["guard"], *(f"{float(row[key]):.3g}" for key in ("guard_ms", "whole_ms", "percent")))
        for row in rows
    ]
    return "\n".join([*lines, *(table_line(cells) for cells in figures), ""])


if __name__ == "__main__":
    main(*sys.argv[1:])
