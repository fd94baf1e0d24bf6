"""The tables of docs/failures.md: how score distillation fails and what each remedy gains.

A cell is the median dB over the seeds with its range, and the share that shows the failure; gains
are relative to the failing variant. `runs.py` measures, `make docs` writes the page.
"""

import statistics
from typing import NamedTuple

from benchmarks.quality.chart_runs import ends, grouped, objects_of
from benchmarks.quality.runs import rows_of

SHARES = {"multi_face": "multi-face", "out_of_gamut": "out of gamut", "floater_mass": "floaters"}


class Failure(NamedTuple):
    """A way to fail, and what helps; both are variants of jobs.py."""

    title: str
    share: str
    """The column that shows it, besides the dB."""
    without: str
    remedies: dict[str, str]
    """What a user does, to the variant of it."""
    chart: str = "failures"


FAILURES = [
    Failure(
        "Multi-face",
        "multi_face",
        "multi-face: random start",
        {
            "a view-dependent score": "multi-face: random start + view-dependent score",
            "a prior with shape and colours (the default)": "multi-face: prior",
        },
    ),
    Failure(
        "Multi-face, an object whose front and back differ in colour only",
        "multi_face",
        "same shape: grey prior",
        {
            "a view-dependent score": "same shape: grey prior + view-dependent score",
            "a prior with colours": "same shape: coloured prior",
            "both": "same shape: coloured prior + view-dependent score",
        },
        chart="front_back",
    ),
    Failure(
        "Prior without colours",
        "multi_face",
        "grey prior",
        {
            "a view-dependent score": "grey prior + view-dependent score",
            "a prior with colours": "multi-face: prior",
        },
    ),
    Failure(
        "Prior of the wrong shape (a grey sphere)",
        "floater_mass",
        "wrong shape: a grey sphere",
        {"a prior of the right shape": "right shape"},
    ),
    Failure(
        "Over-saturation at guidance 100",
        "out_of_gamut",
        "over-saturation: guidance 100",
        {
            "`max_step_percent` falling to 0.55 (the default)": "over-saturation: annealed",
            "and `grad_clip: [0, 1.5, 2.0, 1000]`": "over-saturation: annealed, clipped",
            "and `guidance_scale: 7.5`": "over-saturation: guidance 7.5, annealed, clipped",
        },
    ),
    Failure(
        "Blur from timesteps up to 0.98 throughout",
        "multi_face",
        "blur: timesteps up to 0.98 throughout",
        {"`max_step_percent` falling to 0.55 (the default)": "multi-face: prior"},
    ),
    Failure(
        "Blur from a coarse latent (4²)",
        "multi_face",
        "blur: coarse latent",
        {"a latent of 16²": "multi-face: prior"},
    ),
    Failure(
        "Blur and floaters from a screen-space dilation of 0.3 square pixels",
        "floater_mass",
        "plain 0.3",
        {"`renderer.eps2d: 0.1`": "plain 0.1"},
        chart="dilation",
    ),
    Failure(
        "Unneeded Gaussians",
        "floater_mass",
        "no pruning",
        {"`budget: auto`": "by removal error, auto", "`budget: 2500`": "by removal error 2500"},
        chart="count",
    ),
]


class Ends(NamedTuple):
    """What the runs of one variant on one object ended with, a value per seed."""

    psnr: list[float]
    share: list[float]
    gaussians: list[float]


def tables() -> str:
    """Return all tables of docs/failures.md."""
    return "\n" + "\n\n".join(filter(None, map(table, FAILURES))) + "\n"


def table(failure: Failure) -> str:
    """One table, a column for each object; empty where nothing is measured."""
    objects = objects_of(rows_of(failure.chart))
    if not objects:
        return ""
    worst = {name: measured(failure, failure.without, name) for name in objects}
    lines = [f"| {failure.title} | {' | '.join(objects)} |", "| --- |" + " --- |" * len(objects)]
    lines.append(
        f"| without remedy | {' | '.join(cell(worst[name], failure) for name in objects)} |"
    )
    for remedy, variant in failure.remedies.items():
        cells = [cell(measured(failure, variant, name), failure, worst[name]) for name in objects]
        lines.append(f"| {remedy} | {' | '.join(cells)} |")
    return "\n".join(lines)


def measured(failure: Failure, variant: str, name: str) -> Ends:
    """``variant`` may end with the place on the chart's axis, where it has several."""
    rows = [
        row
        for row in rows_of(failure.chart)
        if row["object"] == name and variant in (row["variant"], f"{row['variant']} {row['x']}")
    ]
    last = [end for place in grouped(rows, lambda row: row["x"]).values() for end in ends(place)]
    return Ends(
        *([float(row[column]) for row in last] for column in ("psnr", failure.share, "gaussians"))
    )


def cell(here: Ends, failure: Failure, worst: Ends | None = None) -> str:
    if not here.psnr:
        return "not measured"
    middle = statistics.median(here.psnr)
    text = f"{middle:.1f} dB ({min(here.psnr):.1f} – {max(here.psnr):.1f})"
    if worst and worst.psnr:
        text = f"**{middle - statistics.median(worst.psnr):+.1f}**: {text}"
    if failure.chart == "count":
        text += f", {statistics.median(here.gaussians):.0f} Gaussians"
    return f"{text}, {100 * statistics.median(here.share):.1f} % {SHARES[failure.share]}"
