"""How much the results of one prompt differ between seeds, by runs that toybox.py has kept.

    python -m benchmarks.quality.toybox --keep RUNS --charts default distillations --seeds 0 1 2 3 4
    python -m benchmarks.quality.toybox_diversity --keep RUNS --charts default distillations

Writes toybox_diversity.csv: the root mean square difference of the judge's views between two seeds,
averaged over all pairs, as a share of the range of colours; a row for each variant and prompt of
which two seeds or more are kept.
"""

import argparse
from pathlib import Path

import numpy as np
from jaxtyping import Float

from benchmarks.markdown import write_rows
from benchmarks.quality import toybox
from benchmarks.quality.chart_runs import grouped
from benchmarks.quality.runs import CHARTS
from benchmarks.quality.toybox_options import CHARTS as VARIANTS
from benchmarks.quality.toybox_scores import views_of
from benchmarks.quality.toybox_variants import DIVERSITY
from benchmarks.quality.variant_charts import difference_of
from threestudio_gaussiandreamer import register_parts

COLUMNS = ["variant", "x", "withheld", "index", "setup", "seeds", "diversity"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    add = parser.add_argument
    add("--keep", type=Path, required=True, help="folder of the runs")
    add("--charts", nargs="+", choices=VARIANTS, default=list(VARIANTS))
    add("--prompts", nargs="+", choices=("seen", "withheld"), default=["withheld"])
    add("--count", type=int, default=20, help="of prompts of each sort (default: 20)")
    add("--seeds", type=int, nargs="+", default=list(range(5)))
    add("--models", default="toybox", help="toybox, or the folder of an export")
    add("--gpu", type=toybox.device, default=toybox.CPU, help="as the runs were made with")
    add("--out", type=Path, default=CHARTS, help="folder of the CSV (default: docs/charts)")
    arguments = parser.parse_args()
    arguments.variant = []
    register_parts()
    path = arguments.out / f"{DIVERSITY}.csv"
    write_rows(path, COLUMNS, list(rows_of(arguments)))
    print(path)


def rows_of(arguments: argparse.Namespace) -> list[tuple[str, ...]]:
    """Return a row for each variant and prompt of which two seeds or more are kept."""
    kept = [
        task
        for task in toybox.unique(toybox.tasks(arguments))
        if (toybox.kept(task) / toybox.RECORD).exists()
    ]
    groups = grouped(kept, lambda task: (*task.variant.key, task.prompt, task.setup))
    return [
        (
            *tasks[0].variant.key,
            str(int(tasks[0].prompt.withheld)),
            str(tasks[0].prompt.index),
            tasks[0].setup,
            str(len(tasks)),
            f"{difference_of(map(kept_views, tasks)):.4f}",
        )
        for tasks in groups.values()
        if len(tasks) > 1
    ]


def kept_views(task: toybox.Task) -> Float[np.ndarray, "V H W 3"]:
    """Render a kept run's result from the judge's directions."""
    return views_of(toybox.kept(task) / toybox.RUN).numpy()


if __name__ == "__main__":
    main()
