"""The tables of the CPU kernel in docs/rasteriser.md, from benchmarks/results/kernel.csv."""

from collections.abc import Iterator, Sequence
from typing import Optional

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import grouped
from benchmarks.quality.runs import ROOT

KERNEL = ROOT / "benchmarks/results/kernel.csv"
Case = dict[str, dict[str, str]]
"""The rows of "before", "now", and maybe "prototype"."""
AIMS = {
    ("surface", "v4"): ("prototype", (1.0, 0.8)),
    ("surface", "v3"): ("prototype", (1.5,)),
    ("demo", None): ("before", (0.7,)),
    ("demo's settings", None): ("before", (0.7,)),
}
"""What "now" is compared with, and the largest ratios, by scene and by build (None: any)."""


def kernel() -> str:
    """Return times of the CPU kernel before and now, and ratios, also to the prototype: a table for
    each machine and pair of commits.
    """
    cases: list[Case] = []
    for row in read(KERNEL):
        if row["contender"] == "before":
            cases.append({})
        cases[-1][row["contender"]] = row
    measured = grouped(
        cases,
        lambda case: (case["now"]["machine"], case["before"]["commit"], case["now"]["commit"]),
    )
    return "\n\n".join(_table(*where, found) for where, found in measured.items())


def _table(machine: str, before: str, now: str, cases: Sequence[Case]) -> str:
    lines = []
    for case in cases:
        ms = {name: float(row["both_ms"]) for name, row in case.items()}
        ratios = (_ratio(case, name) for name in ("before", "prototype"))
        shown = (f"{ratio:.2f}" if ratio else "" for ratio in ratios)
        times = f"{ms['before']:.1f}", f"{ms['now']:.1f}"
        aims = "; ".join(_aims(case))
        lines.append((_title(case["now"]), case["now"]["build"], *times, *shown, aims))
    head = ("scene", "build", f"before ({before}), ms", f"now ({now}), ms")
    head += ("now / before", "now / AVX-512 prototype", "aim")
    return f"{machine}:\n\n{markdown(head, lines)}"


def _title(row: dict[str, str]) -> str:
    views = f"{row['views']} × " if row["views"] != "1" else ""
    threads = f", {row['threads']} threads" if row["threads"] != "1" else ""
    return f"{row['scene']}, {int(row['gaussians']):,} Gaussians, {views}{row['size']}²{threads}"


def _ratio(case: Case, name: str) -> Optional[float]:
    return float(case["now"]["both_ms"]) / float(case[name]["both_ms"]) if name in case else None


def _aims(case: Case) -> Iterator[str]:
    """Yield each aim of a case of one thread, and whether it is reached."""
    row = case["now"]
    found = AIMS.get((row["scene"], row["build"])) or AIMS.get((row["scene"], None))
    if not found or row["threads"] != "1":
        return
    other, limits = found
    ratio = _ratio(case, other)
    for limit in limits:
        result = "not measured" if ratio is None else "reached" if ratio <= limit else "missed"
        yield f"≤ {limit:.1f} of {'the prototype' if other == 'prototype' else other}: {result}"
