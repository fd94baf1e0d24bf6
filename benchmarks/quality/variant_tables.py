"""The measured parts of docs/distillation.md."""

import math
from collections.abc import Iterable
from typing import Optional

from benchmarks.markdown import markdown
from benchmarks.quality.chart_runs import PAPER, Row, ends, grouped, median, objects_of
from benchmarks.quality.runs import rows_of
from benchmarks.quality.variant_charts import DIVERSITY, at_best, of_one_machine
from benchmarks.quality.variants import (
    BINNED,
    BLIND,
    CHART,
    CHEAPER,
    CLIPPED,
    DISTILLATIONS,
    FROM_BALL,
    LINES,
    SDS,
    best_scales,
    median_end,
)

LENGTHS = ("SDS, a quarter of the steps", "SDS, half the steps", SDS, "SDS, twice the steps")
"""SDS at several numbers of evaluations, to compare the others with."""


def last(rows: Iterable[Row]) -> list[Row]:
    """Return the last row of each run, of any object."""
    return [row for own in grouped(rows, lambda row: row["object"]).values() for row in ends(own)]


def per_object(rows: list[Row], objects: list[str]) -> list[str]:
    """Return the median dB at the end on each object; a dash where there is no run."""
    of_object = grouped(rows, lambda row: row["object"])
    return [f"{median_end(of_object[name]):.1f}" if name in of_object else "–" for name in objects]


def faults(found: list[Row]) -> list[str]:
    """Return the medians of the multi-face rate and of the share of colours out of gamut."""
    shares = median(found, "multi_face"), 100 * median(found, "out_of_gamut")
    return [f"{shares[0]:.2f}", f"{shares[1]:.1f} %"]


def line_of(label: str) -> str:
    """Return the line that a label with its scale is of."""
    return CLIPPED if label == PAPER else label.partition(", s =")[0]


def quality() -> str:
    """Return the scores of each distillation at its best guidance scale, best first."""
    rows = rows_of(CHART)
    shown = at_best(rows, DISTILLATIONS)
    objects = objects_of(shown)
    lines = []
    for label, own in grouped(shown, lambda row: row["variant"]).items():
        found = last(own)
        cells = [
            *per_object(own, objects),
            *faults(found),
            f"{median(found, 'saturation'):.2f}",
            f"{median(found, 'evaluations'):,.0f}",
            f"{median(of_one_machine(found), 'cpu_seconds'):.0f}",
            tried(label, rows),
            diversity(line_of(label), found[0]["x"]),
            own_scale(label, rows),
        ]
        first = [row for row in own if row["object"] == objects[0]]
        lines.append((median_end(first), [f"{label}", *cells]))
    heads = ["variant, scale", *(f"dB, {name}" for name in objects), "multi-face", "out of gamut"]
    heads += ["saturation", "evaluations", "CPU seconds", "scales tried", "diversity"]
    heads += ["dB at its paper's scale"]
    ordered = [cells for _, cells in sorted(lines, key=lambda line: -line[0])]
    return f"{head_of(shown)}\n\n{markdown(heads, ordered)}"


def head_of(rows: list[Row]) -> str:
    """Return what the runs of a table have in common."""
    counts = grouped({(row["object"], row["seed"]) for row in rows}, lambda pair: pair[0])
    seeds = ", ".join(f"{name} {len(counts[name])}" for name in objects_of(rows))
    machines = ", ".join(sorted({row["machine"] for row in rows}))
    return f"Seeds: {seeds}. {machines}."


def tried(label: str, rows: list[Row]) -> str:
    """Return the guidance scales at which a line was run."""
    name = line_of(label)
    scales = {float(row["x"]) for row in rows if (row["truth"], row["variant"]) == (BINNED, name)}
    return ", ".join(f"{scale:g}" for scale in sorted(scales))


def own_scale(label: str, rows: list[Row]) -> str:
    """Return the median dB on the first object at the scale of the line's paper."""
    line = LINES.get(label.partition(", s =")[0])
    if line is None or line.own_scale is None:
        return "–"
    scale = f"{line.own_scale:g}"
    found = [
        row
        for row in rows
        if row["truth"] == BINNED
        and label.startswith(f"{row['variant']}, s =")
        and row["x"] == scale
        and row["object"] == objects_of(rows)[0]
    ]
    return f"{median_end(found):.1f} (s = {scale})" if found else "–"


def diversity(label: str, scale: str) -> str:
    """Return the median over the objects of the diversity over the seeds."""
    found = [
        row
        for row in rows_of(DIVERSITY)
        if (row["truth"], row["variant"], row["x"]) == (BINNED, label, scale)
    ]
    return f"{median(found, 'diversity'):.3f}" if found else "–"


def blind() -> str:
    """Return dB and multi-face of each distillation with the view-agnostic score, best first."""
    rows = [row for row in rows_of(CHART) if row["truth"] == BLIND]
    if not rows:
        return "With the view-agnostic score nothing has been measured yet."
    objects = objects_of(rows)
    lines = []
    for label, own in grouped(rows, lambda row: row["variant"]).items():
        found = last(own)
        cells = [label, *per_object(own, objects), *faults(found)]
        lines.append((median(found, "psnr"), cells))
    heads = ["variant", *(f"dB, {name}" for name in objects), "multi-face", "out of gamut"]
    return markdown(heads, [cells for _, cells in sorted(lines, key=lambda line: -line[0])])


def from_ball() -> str:
    """Return what the choices of timesteps make of a ball."""
    rows = [row for row in rows_of(CHART) if row["variant"] in FROM_BALL]
    objects = objects_of(rows)
    lines = [
        [label, *per_object(own, objects), *faults(last(own))]
        for label, own in grouped(rows, lambda row: row["variant"]).items()
    ]
    heads = ["line", *(f"dB, {name}" for name in objects), "multi-face", "out of gamut"]
    return f"{head_of(rows)}\n\n{markdown(heads, lines)}" if rows else "Not measured yet."


def cheaper() -> str:
    """Return what fewer evaluations per step, or fewer steps, gain against SDS of as many
    evaluations.
    """
    rows = rows_of(CHART)
    shown, best = at_best(rows, [SDS, *CHEAPER]), best_scales(rows)
    objects = objects_of(shown)
    lines = []
    for label in (name for name in [SDS, *CHEAPER] if name in best):
        own = [row for row in shown if row["variant"].startswith(f"{label}, s =")]
        gains = [gain for row in last(own) if (gain := gain_of(row, rows, best)) is not None]
        cells = [
            f"{label}, s = {best[label]}",
            *per_object(own, objects),
            f"{median(last(own), 'evaluations'):,.0f}",
            f"{median(of_one_machine(last(own)), 'cpu_seconds'):.0f}",
            tried(f"{label}, s =", rows),
            f"{sorted(gains)[len(gains) // 2]:+.1f}" if gains else "–",
        ]
        lines.append(cells)
    heads = ["line, scale", *(f"dB, {name}" for name in objects), "evaluations", "CPU seconds"]
    heads += ["scales tried", "dB − SDS"]
    return f"{head_of(shown)}\n\n{markdown(heads, lines)}"


def gain_of(row: Row, rows: list[Row], best: dict[str, str]) -> Optional[float]:
    """Return dB minus those of SDS of as many evaluations on the same object and seed, which are
    interpolated between its lengths; None beyond them.
    """
    same = [
        other
        for other in rows
        if other["truth"] == BINNED
        and other["variant"] in LENGTHS
        and other["x"] == best[other["variant"]]
        and (other["object"], other["seed"]) == (row["object"], row["seed"])
    ]
    front = sorted(
        (math.log(float(end["evaluations"])), float(end["psnr"]))
        for own in grouped(same, lambda other: other["variant"]).values()
        for end in ends(own)
    )
    at = math.log(float(row["evaluations"]))
    for (low, below), (high, above) in zip(front, front[1:], strict=False):
        if low - 1e-9 <= at <= high + 1e-9:
            share = (at - low) / (high - low)
            return float(row["psnr"]) - (1 - share) * below - share * above
    return None
