"""Curves of a run's logs as SVG that stands inside a page."""

import csv
import html
import math
from collections.abc import Sequence
from pathlib import Path

WIDTH, HEIGHT, LEFT, BOTTOM, TOP = 340, 180, 56, 20, 22
MAX_POINTS = 400
"""More than that can't be told apart in a curve of this width."""
Curve = list[tuple[float, float]]
"""Steps and values, by step."""


def read_curves(folder: Path, names: Sequence[str]) -> dict[str, Curve]:
    """Read columns of the CSV logs of a run; a resumed run has several, of which later ones win.

    Args:
        folder: of the run.

    Returns:
        the curves that have at least two finite values.
    """
    values: dict[str, dict[float, float]] = {name: {} for name in names}
    logs = folder.glob("csv_logs/version_*/metrics.csv")
    for path in sorted(logs, key=lambda path: (len(path.parent.name), path.parent.name)):
        _add_log(path, values)
    return {name: sorted(found.items()) for name, found in values.items() if len(found) > 1}


def _add_log(path: Path, values: dict[str, dict[float, float]]) -> None:
    try:
        with open(path, newline="", encoding="utf-8", errors="replace") as file:
            for row in csv.DictReader(file):
                step = _number(row.get("step"))
                for name, found in values.items():
                    value = _number(row.get(name))
                    if math.isfinite(step) and math.isfinite(value):
                        found[step] = value
    except (OSError, csv.Error):
        pass  # a page without this curve is better than none


def _number(text: object) -> float:
    try:
        return float(str(text))
    except ValueError:
        return math.nan


def number(value: float) -> str:
    """Format a number with five digits, or all that are before its point; none is large enough for
    an exponent.
    """
    return f"{value:,.0f}" if abs(value) >= 1e4 else f"{value:.5g}"


def svg(curve: Curve, title: str) -> str:
    """Draw a curve over steps; values that span several powers of ten on a logarithmic axis."""
    curve = curve[:: -(-len(curve) // MAX_POINTS)]
    steps, values = zip(*curve, strict=True)
    logarithmic = min(values) > 0 and max(values) > 100 * min(values)
    heights = [math.log10(value) if logarithmic else value for value in values]
    xs = _scaled(steps, LEFT, WIDTH - 8)
    ys = _scaled(heights, HEIGHT - BOTTOM, TOP)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in zip(xs, ys, strict=True))
    heading = f"{title}, logarithmic" if logarithmic else title
    return (
        f'<svg viewBox="0 0 {WIDTH} {HEIGHT}" width="{WIDTH}" height="{HEIGHT}" role="img">'
        f"<title>{html.escape(heading)}</title>"
        f'<path d="M{LEFT},{TOP}V{HEIGHT - BOTTOM}H{WIDTH - 8}" fill="none" stroke="#bbb"/>'
        f'<polyline points="{points}" fill="none" stroke="#25c" stroke-width="1.5"/>'
        + _text(LEFT, 14, heading, "start")
        + _text(LEFT - 4, TOP + 8, number(max(values)), "end")
        + _text(LEFT - 4, HEIGHT - BOTTOM, number(min(values)), "end")
        + _text(LEFT, HEIGHT - 6, f"step {number(steps[0])}", "start")
        + _text(WIDTH - 8, HEIGHT - 6, number(steps[-1]), "end")
        + "</svg>"
    )


def _text(x: float, y: float, text: str, anchor: str) -> str:
    return f'<text x="{x}" y="{y}" text-anchor="{anchor}">{html.escape(text)}</text>'


def _scaled(values: Sequence[float], first: float, last: float) -> list[float]:
    """Map the range of the values to ``first`` to ``last``; a constant lies in the middle."""
    low, span = min(values), max(values) - min(values)
    return [first + (last - first) * ((value - low) / span if span else 0.5) for value in values]
