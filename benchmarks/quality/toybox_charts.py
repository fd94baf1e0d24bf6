"""The charts of docs/toybox.md, from docs/charts/toybox.csv and toybox_gpu.csv.

    python -m benchmarks.quality.toybox_charts      # draws docs/charts/toybox_*.png

Lines show results against a number that runs vary; `toybox_settings.png` and
`toybox_distillations.png` show the difference of each other setting, and of each other score
distillation, to toybox.yaml on the same prompts and seeds, and the ratio of their seconds. Bands
and bars are bootstrap intervals over prompts. `toybox_seconds.png` shows the differences of all of
them against this ratio.
"""

import math
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from benchmarks.figures import pyplot
from benchmarks.quality.chart_runs import median, saved, set_log_x
from benchmarks.quality.toybox_jobs import (
    COUNT,
    DEFAULT,
    EXACT,
    GUIDANCE,
    PAPER_RECIPE,
    RECOGNIZED,
    SAMPLES,
    STEPS,
    TRUTH,
)
from benchmarks.quality.toybox_tables import (
    TITLES,
    Row,
    estimate,
    is_present,
    present,
    title_of,
)
from benchmarks.quality.toybox_variants import (
    DISTILLATIONS,
    ENOUGH,
    SETTINGS,
    all_runs,
    multi_face,
    pairs_of_charts,
    paper_marked,
    recognised_share,
    relative,
    runs_with_looks,
    seconds_of_variants,
    values_of,
)
from threestudio_gaussiandreamer.evaluation.intervals import paired


class Line(NamedTuple):
    """A chart of results against a number that runs vary."""

    variant: str
    own: float
    """The number in toybox.yaml, whose runs are in the chart too."""
    x_column: str
    x_label: str
    star: str = ""
    """The value of ``x`` that is the paper's."""


LINES = {
    "toybox_guidance": Line(
        "guidance scale", GUIDANCE, "x", "guidance scale (star: the paper's)", "101"
    ),
    "toybox_steps": Line(
        "steps", STEPS, "cpu_seconds", "CPU seconds, one thread; at the points: steps"
    ),
    "toybox_count": Line("Gaussians", COUNT, "x", "Gaussians"),
}
RELATIVE_SECONDS = "CPU seconds / those of toybox.yaml"
RELATIVE_EVALUATIONS = "evaluations of the 2D model / those of toybox.yaml"
COMPARISONS = {"toybox_settings": SETTINGS, "toybox_distillations": DISTILLATIONS}


def main() -> None:
    rows = present()
    for name, line in LINES.items():
        if varied := [row for row in rows if row["variant"] == line.variant]:
            print(draw(name, line, varied + default_at(line, varied, rows), references(rows)))
    ratios = seconds_of_variants()
    for name, charts in COMPARISONS.items():
        if found := settings(all_runs(), charts):
            print(draw_settings(name, found, ratios))
    charts = [name for name in (*SETTINGS, *DISTILLATIONS) if name != "wrong_priors"]
    compared = settings(all_runs(), charts, others=(EXACT,))
    counts = relative("evaluations", runs_with_looks())
    for name, label, against in (
        ("toybox_seconds", RELATIVE_SECONDS, ratios),
        ("toybox_evaluations", RELATIVE_EVALUATIONS, counts),
    ):
        if shown := [one for one in compared if one.title in against]:
            print(draw_against(name, label, shown, against))


# ---- results against a number --------------------------------------------------------------------


def default_at(line: Line, varied: list[Row], rows: list[Row]) -> list[Row]:
    """Return the rows of toybox.yaml, of prompts and seeds that the chart has, as its own point."""
    shown = {(row["prompt"], row["seed"]) for row in varied}
    own = [row for row in rows if row["variant"] == DEFAULT]
    same = [row for row in own if (row["prompt"], row["seed"]) in shown]
    return [row | {"x": f"{line.own:g}"} for row in same]


def references(rows: list[Row]) -> dict[str, Callable[[str], float]]:
    """Return what is drawn as a horizontal line in the panel of a column."""
    chosen = [row for row in rows if row["variant"] == DEFAULT]
    best = [row for row in rows if row["variant"] == SAMPLES and row["x"] == "4"]
    truth = [row for row in rows if row["variant"] == TRUTH]
    return {
        "prior": lambda name: estimate(chosen, name, "prior_").mean,
        "2D model": lambda name: estimate(best, name).mean,
        "truth": lambda name: estimate(truth, name).mean,
    }


def draw(name: str, line: Line, rows: list[Row], levels: dict[str, Callable[[str], float]]) -> Path:
    """Draw one figure, a panel per column of RECOGNIZED; return the path."""
    plt = pyplot()

    figure, panels = plt.subplots(1, len(RECOGNIZED), figsize=(15, 3.6), sharey=True)
    for panel, column in zip(panels, RECOGNIZED, strict=True):
        draw_panel(panel, line, column, rows)
        for (label, level), style in zip(levels.items(), ("--", ":", "-."), strict=True):
            if not math.isnan(value := level(column)):
                panel.axhline(100 * value, linestyle=style, color="0.5", label=label)
        panel.set_title(TITLES.get(column, column), fontsize=10)
    panels[0].set_ylabel("%")
    panels[-1].legend(fontsize=8)
    figure.supxlabel(line.x_label, fontsize=10)
    figure.tight_layout()
    return saved(figure, name)


def draw_panel(panel: Any, line: Line, column: str, rows: list[Row]) -> None:
    """Draw mean and interval of one column at each value of ``x``, and the value itself where the
    axis has another number.
    """
    places = sorted({row["x"] for row in rows}, key=float)
    groups = [[row for row in rows if row["x"] == place] for place in places]
    found = [estimate(group, column) for group in groups]
    x = [median(group, line.x_column) for group in groups]
    middle = [100 * value.mean for value in found]
    panel.fill_between(
        x, [100 * v.low for v in found], [100 * v.high for v in found], alpha=0.2, linewidth=0
    )
    panel.plot(x, middle, marker="o")
    for place, across, value in zip(places, x, middle, strict=True):
        if place == line.star:
            panel.plot([across], [value], marker="*", markersize=14, color="0.15")
        if line.x_column != "x":
            above = {"xytext": (0, 6), "textcoords": "offset points", "ha": "center"}
            panel.annotate(place, (across, value), fontsize=8, color="C0", **above)
    set_log_x(panel)
    panel.margins(x=0.1)
    finish(panel)


# ---- settings against toybox.yaml ----------------------------------------------------------------


class Setting(NamedTuple):
    """A variant of toybox.yaml, and toybox.yaml itself on the same prompts and seeds."""

    own: list[Row]
    plain: list[Row]

    @property
    def title(self) -> str:
        return title_of(self.own[0])


VARIED = (EXACT, *(line.variant for line in LINES.values()))
"""Variants that other charts show."""


def settings(
    rows: Sequence[Row], charts: Sequence[str], others: Sequence[str] = VARIED
) -> list[Setting]:
    """Return the settings of some charts that were measured with the present models and
    configuration, without some variants.
    """
    return [
        Setting(own, plain)
        for own, plain in pairs_of_charts(rows, charts)
        if own[0]["variant"] not in others and is_present(own[0]) and len(own) >= ENOUGH
    ]


def draw_settings(name: str, found: Sequence[Setting], ratios: dict[str, float]) -> Path:
    """Draw differences and relative seconds, a line per setting; return the path."""
    plt = pyplot()

    figure, panels = plt.subplots(
        1, 3, figsize=(13, 1.4 + 0.32 * len(found)), sharey=True, width_ratios=(2, 2, 1)
    )
    draw_differences(panels[0], found, recognised_share, "recognised attributes, points")
    draw_differences(panels[1], found, multi_face, "multi-face, points")
    draw_seconds(panels[2], found, ratios)
    panels[0].set_yticks(range(len(found)), [paper_marked(one.title) for one in found])
    panels[0].invert_yaxis()
    title = "Difference to toybox.yaml on the same prompts and seeds"
    figure.suptitle(title, fontsize=11)
    figure.tight_layout()
    return saved(figure, name)


def draw_differences(
    panel: Any, found: Sequence[Setting], measure: Callable[[Row], float], label: str
) -> None:
    """Draw the mean difference of each setting to toybox.yaml, and its interval."""
    for place, one in enumerate(found):
        value = paired(values_of(one.own, measure), values_of(one.plain, measure))
        panel.plot([100 * value.low, 100 * value.high], [place, place], color="C0", linewidth=1.6)
        panel.plot([100 * value.mean], [place], "o", color="C0")
    panel.axvline(0, color="0.5", linewidth=1)
    finish(panel, label)


def draw_seconds(panel: Any, found: Sequence[Setting], ratios: dict[str, float]) -> None:
    """Draw the ratio of each setting's seconds to those of toybox.yaml, where it is known."""
    for place, one in enumerate(found):
        panel.plot([ratios.get(one.title, math.nan)], [place], "o", color="C1")
    panel.axvline(1, color="0.5", linewidth=1)
    panel.margins(x=0.1)
    panel.set_xlim(left=0)
    finish(panel, RELATIVE_SECONDS.replace("/ ", "/\n"))


# ---- results against seconds or evaluations ------------------------------------------------------


def draw_against(name: str, label: str, found: Sequence[Setting], ratios: dict[str, float]) -> Path:
    """Draw each setting as a point: its difference to toybox.yaml in recognised attributes and in
    the multi-face rate against relative seconds or evaluations; toybox.yaml itself at (1, 0), the
    paper's recipe as a star.
    """
    plt = pyplot()

    figure, panels = plt.subplots(1, 2, figsize=(14, 6), layout="constrained")
    colors = plt.get_cmap("tab20").colors
    for panel, measure in zip(panels, (recognised_share, multi_face), strict=True):
        panel.plot([1], [0], "D", color="0.2", markersize=11, label=DEFAULT)
        for place, one in enumerate(found):
            value = paired(values_of(one.own, measure), values_of(one.plain, measure))
            turn, color = divmod(place, len(colors))
            marker, size = ("*", 16) if one.title == PAPER_RECIPE else ("osv^"[turn], 7)
            panel.plot([ratios[one.title]], [100 * value.mean], marker, color=colors[color],
                       markersize=size, label=one.title, markeredgecolor="0.2")  # fmt: skip
        panel.axhline(0, color="0.5", linewidth=1)
        set_log_x(panel)
        finish(panel, label)
    panels[0].set_ylabel("recognised attributes, difference to toybox.yaml, points")
    panels[1].set_ylabel("multi-face, difference to toybox.yaml, points")
    figure.legend(*panels[0].get_legend_handles_labels(), loc="outside right center", fontsize=8)
    return saved(figure, name)


# ---- both ----------------------------------------------------------------------------------------


def finish(panel: Any, label: str = "") -> None:
    panel.set_xlabel(label, fontsize=9)
    panel.grid(alpha=0.25)
    panel.spines[["top", "right"]].set_visible(False)


if __name__ == "__main__":
    main()
