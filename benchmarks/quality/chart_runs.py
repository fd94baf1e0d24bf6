"""Draw the run charts: docs/charts/<name>.png from docs/charts/<name>.csv, which `runs.py` writes.

    python -m benchmarks.quality.chart_runs                # all that have been measured
    python -m benchmarks.quality.chart_runs time count

Lines are medians over the seeds, bands and bars the whole range. Each panel is one object; settings
were tuned on the first."""

import argparse
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.figures import pyplot
from benchmarks.quality.runs import CHARTS, SIZE, rows_of

Row = dict[str, str]
TUNED_ON = "toy"
PAPER = "the paper's recipe"


class Chart(NamedTuple):
    """How a CSV is drawn."""

    title: str
    x: str
    """The column on the horizontal axis."""
    x_label: str
    curves: bool
    """Whether each run is a curve over its steps, or a point at its end."""
    size: int = SIZE
    """Width and height of the renders, pixels."""
    chosen_on: tuple[str, ...] = (TUNED_ON,)
    """The objects that settings were chosen on."""
    front: tuple[str, ...] = ()
    """Variants whose medians a line connects."""


DECIBEL = "held-out PSNR, dB"
COLOURS = [f"C{index}" for index in (0, 1, 2, 3, 4, 5, 6, 8, 9)]
COLOURS += ["navy", "gold", "lime", "indigo", "salmon"]
NARROWEST = 8.6
"""Width of a chart of one object, inches: its caption needs that."""
SECONDS = "CPU seconds of training, one thread"
RUNS = {
    "time": Chart("Quality over time for each kind of score", "cpu_seconds", SECONDS, curves=True),
    "count": Chart(
        "How many Gaussians a scene needs", "gaussians", "Gaussians at the end", curves=False
    ),
    "quality": Chart(
        "Draft, default and best",
        "cpu_seconds",
        SECONDS,
        curves=False,
        size=256,
        chosen_on=(TUNED_ON, "spot", "duck"),
        front=("draft", "default", "best"),
    ),
}
UNSEEN = RUNS["quality"]._replace(title="Draft, default and best on other objects", chosen_on=())
DRAWN = RUNS | {"unseen": UNSEEN}
"""With a chart whose table in reports/results.md has other columns than the others'."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "charts", nargs="*", help=f"of {', '.join(DRAWN)}; default: all that have been measured"
    )
    for name in parser.parse_args().charts or DRAWN:
        rows = rows_of(name)
        if rows:
            print(draw(name, DRAWN[name], rows))


def draw(name: str, chart: Chart, rows: list[Row]) -> Any:
    """Draw one figure, a panel per object; return the path."""
    plt = pyplot()

    objects = objects_of(rows)
    figure, panels = plt.subplots(
        1,
        len(objects),
        figsize=(max(NARROWEST, 1.2 + 4.2 * len(objects)), 4.6),
        sharey=True,
        squeeze=False,
    )
    labels = list(dict.fromkeys(row["variant"] for row in rows))
    for panel, name_of_object in zip(panels[0], objects, strict=True):
        draw_panel(panel, chart, labels, [row for row in rows if row["object"] == name_of_object])
        panel.set_title(title_of(name_of_object, chart.chosen_on), fontsize=10)
    panels[0, 0].set_ylabel(DECIBEL)
    figure.suptitle(chart.title, x=0.01, ha="left", fontweight="bold")
    columns = min(4 if len(objects) > 1 else 3, len(labels))
    handles, _ = panels[0, 0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="lower center", ncols=columns, frameon=False, fontsize=9)
    figure.text(0.01, 0.905, caption(rows, chart.size), fontsize=8, color="0.35")
    figure.tight_layout(rect=(0, 0.06 + 0.04 * ((len(labels) - 1) // columns), 1, 0.93))
    return saved(figure, name)


def saved(figure: Any, name: str) -> Path:
    """Write a finished figure to docs/charts, and close it; return its path."""
    path = CHARTS / f"{name}.png"
    figure.savefig(path, dpi=110)
    pyplot().close(figure)
    return path


def objects_of(rows: list[Row]) -> list[str]:
    """Return the objects in the order of charts and tables; settings were chosen on the first."""
    return sorted({row["object"] for row in rows}, key=lambda name: (name != TUNED_ON, name))


def title_of(name: str, chosen_on: tuple[str, ...] = (TUNED_ON,)) -> str:
    """Return an object's title, and whether settings were chosen on it."""
    return name if name in chosen_on else f"{name} (held back from tuning)"


def draw_panel(panel: Any, chart: Chart, labels: list[str], rows: list[Row]) -> None:
    """Draw all lines of one object, in the order and colours of their labels."""
    lines = grouped(rows, lambda row: row["variant"])
    for index, label in enumerate(labels):
        chosen = lines.get(label, [])
        color = "0.15" if label.endswith(PAPER) else COLOURS[index % len(COLOURS)]
        style = {"color": color, "label": label}
        (draw_curve if chart.curves else draw_points)(
            panel, chart, chosen, style, "*" if PAPER in label else "o"
        )
    front = [ends(lines[label]) for label in chart.front if label in lines]
    places = [(median(runs, chart.x), spread(runs)[1]) for runs in front]
    if places:
        panel.plot(*zip(*places, strict=True), color="0.7", linewidth=1, zorder=0)
    set_log_x(panel)
    panel.set_xlabel(chart.x_label)
    panel.grid(alpha=0.25)
    panel.spines[["top", "right"]].set_visible(False)


def set_log_x(panel: Any) -> None:
    """Make the horizontal axis logarithmic, with plain numbers at 1, 2 and 5."""
    from matplotlib import ticker

    panel.set_xscale("log")
    panel.xaxis.set_major_locator(ticker.LogLocator(subs=(1, 2, 5)))
    panel.xaxis.set_major_formatter(ticker.FuncFormatter(lambda value, _: f"{value:g}"))
    panel.xaxis.set_minor_formatter(ticker.NullFormatter())


def draw_curve(
    panel: Any, chart: Chart, rows: Iterable[Row], style: dict[str, Any], marker: str
) -> None:
    """Draw the median over the seeds at each step, the range as a band, and a marker at the end."""
    steps = grouped(
        (row for row in rows if float(row["cpu_seconds"]) > 0), lambda row: int(row["step"])
    )
    points = [(median(at, chart.x), *spread(at)) for _, at in sorted(steps.items())]
    x, low, middle, high = zip(*points, strict=True)
    panel.fill_between(x, low, high, color=style["color"], alpha=0.18, linewidth=0)
    panel.plot(x, middle, linewidth=1.6, **style)
    panel.plot(
        x[-1:], middle[-1:], marker, color=style["color"], markersize=10 if marker == "*" else 5
    )


def draw_points(
    panel: Any, chart: Chart, rows: Iterable[Row], style: dict[str, Any], marker: str
) -> None:
    """Draw the median over the seeds at each position, and the range as a bar."""
    places = [ends(at) for at in grouped(rows, lambda row: float(row["x"])).values()]
    points = sorted((median(at, chart.x), *spread(at)) for at in places)
    x, low, middle, high = (list(column) for column in zip(*points, strict=True))
    below = [m - b for m, b in zip(middle, low, strict=True)]
    above = [t - m for m, t in zip(middle, high, strict=True)]
    size = 11 if marker == "*" else 5
    panel.errorbar(
        x, middle, [below, above], marker=marker, markersize=size, linewidth=1.4, capsize=2, **style
    )
    for at in places:
        values = [float(row[chart.x]) for row in at]
        panel.hlines(spread(at)[1], min(values), max(values), color=style["color"], linewidth=1.4)


def ends(rows: Iterable[Row]) -> list[Row]:
    """Return the last row of each run."""
    return [
        max(run, key=lambda row: int(row["step"]))
        for run in grouped(rows, lambda row: row["seed"]).values()
    ]


def grouped(rows: Iterable[Row], key: Callable[[Row], Any]) -> dict[Any, list[Row]]:
    groups: dict[Any, list[Row]] = defaultdict(list)
    for row in rows:
        groups[key(row)].append(row)
    return groups


def median(rows: list[Row], column: str) -> float:
    """Return the median of the rows that have a value, NaN if none has."""
    values = [float(row[column]) for row in rows if row[column]]
    return statistics.median(values) if values else math.nan


def spread(rows: list[Row]) -> tuple[float, float, float]:
    """Return smallest, median and largest dB."""
    values = [float(row["psnr"]) for row in rows]
    return min(values), statistics.median(values), max(values)


def caption(rows: list[Row], size: int = SIZE) -> str:
    """Return a chart's caption: objects, seeds and configuration."""
    counts = sorted(
        {
            len({row["seed"] for row in same})
            for same in grouped(rows, lambda row: (row["variant"], row["object"])).values()
        }
    )
    seeds = " to ".join(map(str, dict.fromkeys([counts[0], counts[-1]])))
    machine, commits = (
        ", ".join(sorted({row[column] for row in rows})) for column in ("machine", "commit")
    )
    spread_over = "one seed" if seeds == "1" else f"{seeds} seeds: median and range"
    return f"exact score of a known object at {size}², {spread_over}; {machine}; commit {commits}"


if __name__ == "__main__":
    main()
