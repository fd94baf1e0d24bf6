"""The table of docs/tried.md: ideas that aren't in the package and what was found, from
benchmarks/results/tried.csv, docs/charts/tried.csv and docs/charts/grown.csv."""

import statistics
from collections.abc import Iterator

from benchmarks.markdown import markdown, read
from benchmarks.quality.chart_runs import Row, grouped
from benchmarks.quality.runs import ROOT, rows_of
from benchmarks.quality.tables import OBJECTS, last_rows

RECORDED = ROOT / "benchmarks/results/tried.csv"
AREAS = {
    "rasteriser": "rasteriser.md#what-makes-the-cpu-kernel-fast",
    "CUDA": "cuda.md#measured-on-gpus",
    "training step": "step_time.md",
    "training": "results.md#changes-of-the-demo-that-were-tried",
    "pruning": "pruning.md#during-training-systemgeometrybudget",
    "distillation": "distillation.md#cheaper-steps",
    "small models": "toybox.md#what-has-been-changed-and-what-it-brought",
}
"""The page and section of each area, in the order of the table."""
ADOPTED = ("antialiased, dilation 0.03", "C: 20,000 to 5,000 Gaussians")
"""Changes of docs/charts/tried.csv that the demo has."""
BETTER = {"40,000 to 5,000 Gaussians": "C"}
"""The state that a change is compared with, where a better one than its base was found."""
GROWN, PRUNED = ("plain gradients", "2500"), ("by removal error", "2500")


def table() -> str:
    """Return all ideas, by area."""
    rows = [*read(RECORDED), *changes_of_the_demo(), growth()]
    areas = grouped(rows, lambda row: row["area"])
    lines = [
        (row["idea"], f"[{area}]({page})", row["finding"], row["evidence"])
        for area, page in AREAS.items()
        for row in areas[area]
    ]
    return markdown(("idea", "where", "finding", "evidence"), lines)


def changes_of_the_demo() -> Iterator[Row]:
    """Yield the changes that the demo doesn't have: the gain over their base, and floaters."""
    rows = rows_of("tried")
    bases = {(row["change"].partition(":")[0], row["object"]): row for row in rows}
    tried = [row for row in rows if row["base"] and row["change"] not in ADOPTED]
    for change, same in grouped(tried, lambda row: row["change"]).items():
        other = BETTER.get(change, same[0]["base"])
        found = (_against(row, bases[other, row["object"]]) for row in same)
        yield {
            "area": "training",
            "idea": f"{change} (compared with {other})",
            "finding": "; ".join(found),
            "evidence": "[`charts/tried.csv`](charts/tried.csv), one seed",
        }


def _against(row: Row, base: Row) -> str:
    better = row["change"] in BETTER
    gain = float(row["psnr"]) - float(base["psnr"]) if better else float(row["gain"])
    floaters = f"floaters {base['floaters']} → {row['floaters']} %"
    return f"{signed(gain, 2)} dB ({row['object']}; {floaters})"


def signed(value: float, digits: int) -> str:
    return f"{value:+.{digits}f}".replace("-", "−")


def growth() -> Row:
    """Return what growing to the budget gains over pruning down to it: medians of pairs."""
    runs = zip(("grown", "count"), (GROWN, PRUNED), strict=True)
    grown, pruned = (
        {(row["object"], row["seed"]): float(row["psnr"]) for row in last_rows(chart)[place]}
        for chart, place in runs
    )
    gains = [
        statistics.median(grown[key] - pruned[key] for key in grown if key[0] == name)
        for name in OBJECTS
    ]
    shown = " / ".join(signed(gain, 1) for gain in gains)
    return {
        "area": "training",
        "idea": "growing to 2,500 Gaussians by gradients, in place of pruning down to them",
        "finding": f"{shown} dB ({' / '.join(OBJECTS)})",
        "evidence": "[table](results.md#growing-by-gradients)",
    }
