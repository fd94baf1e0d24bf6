"""Draw docs/charts/needed.png from needed.csv (``runs --charts needed``): dB against the number of
Gaussians and against seconds, with the choice of ``budget: auto``, and what was needed.

    python -m benchmarks.quality.chart_needed
"""

import math
import statistics

import numpy as np

from benchmarks.figures import pyplot
from benchmarks.quality.chart_runs import COLOURS, DECIBEL, Row, caption, saved, set_log_x
from benchmarks.quality.runs import rows_of

GAIN = 0.5


def main() -> None:
    rows = [row for row in rows_of("needed") if row["step"] != "0"]
    of = {row["object"]: [r for r in rows if r["object"] == row["object"]] for row in rows}
    fixed, chosen = ({name: by(of[name]) for name in of} for by in (curve, choice))
    order = sorted(fixed, key=lambda name: chosen[name][0])
    dense = [row for row in rows if row["x"] == "5657"]
    was = {row["object"]: [float(row[x]) for x in ("cpu_seconds", "psnr")] for row in dense}
    figure, axes = pyplot().subplots(1, 3, figsize=(14, 4.6), width_ratios=(3, 2, 2))
    left, middle, right = axes
    for name, color in zip(order, COLOURS, strict=False):
        left.plot(*zip(*fixed[name], strict=True), color=color, linewidth=1.4)
        left.plot(*chosen[name][:2], "*", color=color, markersize=13, markeredgecolor="white")
        middle.plot(*zip(was[name], chosen[name][:0:-1], strict=True), "-", color=color)
        middle.plot(*chosen[name][:0:-1], "*", color=color, markersize=13, markeredgecolor="white")
    set_log_x(left)
    left.set(xlabel="Gaussians; star: the choice of budget: auto", ylabel=DECIBEL)
    middle.set_xlabel("CPU seconds; from 5,657 Gaussians to auto's")
    places = range(len(order))
    right.barh(places, [chosen[name][0] for name in order], color=COLOURS[: len(order)], alpha=0.8)
    needed = [needed_number(fixed[name]) for name in order]
    right.plot(needed, places, "|", color="0.1", markersize=20, markeredgewidth=2)
    right.set_yticks(places, order)
    right.set_xlabel("Gaussians chosen; line: needed")
    for panel in axes:
        panel.grid(alpha=0.25)
        panel.spines[["top", "right"]].set_visible(False)
    figure.suptitle("As many Gaussians as the scene needs", x=0.01, ha="left", fontweight="bold")
    figure.text(0.01, 0.905, caption(rows, 256), fontsize=8, color="0.35")
    figure.tight_layout(rect=(0, 0, 1, 0.93))
    print(saved(figure, "needed"))
    for name, number in zip(order, needed, strict=True):
        print(f"{name}: {chosen[name][0]:,.0f} of {number:,.0f} needed, {chosen[name][1]:.2f} dB")


def curve(rows: list[Row]) -> list[tuple[int, float]]:
    """Return the medians over the seeds of runs with fixed numbers, as (number, dB)."""
    found: dict[int, list[float]] = {}
    for row in rows:
        if row["variant"] == "a fixed number":
            found.setdefault(int(row["gaussians"]), []).append(float(row["psnr"]))
    return [(count, statistics.median(found[count])) for count in sorted(found)]


def choice(rows: list[Row]) -> tuple[float, ...]:
    """Return the medians over the seeds of (number, dB, CPU seconds) that ``auto`` gave."""
    runs = [row for row in rows if row["variant"] == f"auto, {GAIN:g} dB"]
    columns = ("gaussians", "psnr", "cpu_seconds")
    return tuple(statistics.median(float(run[name]) for run in runs) for name in columns)


def needed_number(points: list[tuple[int, float]], gain: float = GAIN) -> float:
    """Return the smallest number from which twice as many gain less than ``gain`` dB, between
    measured ones by the logarithm of the number, which reaches half a doubling beyond the last;
    NaN if the curve ends before.
    """
    logs, quality = [math.log2(count) for count, _ in points], [psnr for _, psnr in points]
    beyond = (quality[-1] - quality[-2]) / (logs[-1] - logs[-2])
    known = [*logs, logs[-1] + 0.5], [*quality, quality[-1] + 0.5 * beyond]
    tried = np.arange(logs[0], logs[-1] - 0.5, 0.005)
    gained = np.interp(tried + 1, *known) - np.interp(tried, *known)
    enough = tried[gained < gain]
    return float(2 ** enough[0]) if len(enough) else math.nan


if __name__ == "__main__":
    main()
