"""Charts of the variants of score distillation, and their diversity over the seeds.

    python -m benchmarks.quality.variant_charts [--pictures outputs/variants]

Draws docs/charts/variants_*.png and cheaper_steps.png from variants.csv, each line at its best
measured guidance scale. With the pictures of ``benchmarks.quality.variants``, writes the rows of
their runs in docs/charts/variants_diversity.csv: the root mean square difference of the same test
view between two seeds, averaged over the views and all pairs, as a share of the range of colours.
"""

import argparse
import itertools
import statistics
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from benchmarks.markdown import write_rows
from benchmarks.quality import runs
from benchmarks.quality.chart_runs import PAPER, SECONDS, Chart, Row, draw, grouped
from benchmarks.quality.variants import (
    BINNED,
    CHART,
    CHEAPER,
    CLIPPED,
    DISTILLATIONS,
    KEY,
    LINES,
    PAPER_SCALE,
    SDS,
    SIZE,
    best_scales,
    picture_folder,
)
from threestudio_gaussiandreamer.core.images import read

DIVERSITY = "variants_diversity"
EVALUATIONS = "evaluations of the score model"
TITLES = {
    "variants": "Variants of score distillation, each at its best measured guidance scale s",
    "cheaper_steps": "Fewer evaluations per step, SDS at its best measured guidance scale s",
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--pictures", type=Path, help="folder of test views")
    pictures, rows = parser.parse_args().pictures, runs.rows_of(CHART)
    if pictures:
        write_diversity(pictures, rows)
    draw_charts(rows)


def at_best(rows: list[Row], lines: Iterable[str]) -> list[Row]:
    """Return the rows of the lines at their best scales, which their labels then have, and those
    of the paper's recipe; the score knows directions.
    """
    best, lines = best_scales(rows), set(lines)
    rows = [row for row in rows if row["truth"] == BINNED and row["variant"] in lines]
    return [
        row | {"variant": label_at(row["variant"], row["x"])}
        for row in rows
        if row["x"] == best[row["variant"]]
    ] + [
        row | {"variant": PAPER}
        for row in rows
        if row["variant"] == CLIPPED and row["x"] == f"{PAPER_SCALE:g}" != best[CLIPPED]
    ]


def label_at(label: str, scale: str) -> str:
    """Return a line's label with its scale, marked if that is the scale of its paper."""
    own = LINES[label].own_scale
    return f"{label}, s = {scale}" + " (its paper's)" * (own is not None and f"{own:g}" == scale)


def of_one_machine(rows: list[Row]) -> list[Row]:
    """Return the rows of the machine that has the most, since seconds of two aren't comparable."""
    return max(grouped(rows, lambda row: row["machine"]).values(), key=len, default=[])


def draw_charts(rows: list[Row]) -> None:
    shown = {
        ("variants_seconds", "cpu_seconds"): DISTILLATIONS,
        ("variants_evaluations", "evaluations"): DISTILLATIONS,
        ("cheaper_steps", "evaluations"): [SDS, *CHEAPER],
    }
    for (name, column), lines in shown.items():
        title = TITLES.get(name, TITLES["variants"])
        label = SECONDS if column == "cpu_seconds" else EVALUATIONS
        chosen = at_best(rows, lines)
        if column == "cpu_seconds":
            chosen = of_one_machine(chosen)
        if chosen:
            print(draw(name, Chart(title, column, label, curves=True, size=SIZE), chosen))


def write_diversity(pictures: Path, rows: list[Row]) -> None:
    """Compute the diversity of each line, scale and object that has pictures of two seeds or more;
    the other rows stay.
    """
    columns = [*KEY[:-1], "seeds", "diversity"]
    found = {
        tuple(row[name] for name in KEY[:-1]): tuple(row.values())
        for row in runs.rows_of(DIVERSITY)
    }
    runs_of = grouped({tuple(row[name] for name in KEY) for row in rows}, lambda key: key[:-1])
    for place, keys in runs_of.items():
        folders = [picture_folder(pictures, key) for key in sorted(keys)]
        folders = [folder for folder in folders if folder.is_dir()]
        if len(folders) > 1:
            found[place] = (*place, len(folders), f"{difference(folders):.4f}")
    ordered = [found[place] for place in sorted(found)]
    write_rows(runs.CHARTS / f"{DIVERSITY}.csv", columns, ordered)


def difference(folders: list[Path]) -> float:
    """Return :func:`difference_of` the pictures in these folders."""
    return difference_of(
        np.stack([read(path) for path in sorted(folder.glob("*.png"))]) / 255 for folder in folders
    )


def difference_of(runs_views: Iterable[np.ndarray]) -> float:
    """Return the mean over pairs of runs of the root mean square difference of their views."""
    return statistics.mean(
        float(np.sqrt(np.mean((a - b) ** 2))) for a, b in itertools.combinations(runs_views, 2)
    )


if __name__ == "__main__":
    main()
