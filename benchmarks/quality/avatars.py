"""Avatars: sentences about persons by toybox-avatar.yaml, and what it is compared with.

    python -m benchmarks.quality.avatars                                    # all missing runs
    python -m benchmarks.quality.avatars --models FOLDER --keep RUNS --out DIR --seconds 3000
    python -m benchmarks.quality.avatars --keep RUNS --sheet docs/images/toybox-avatars.jpg

Runs, options and scores are those of benchmarks/quality/toybox.py, whose rows also say whether the
judge recognises the action, and its side. The prompts are the first withheld persons of a seed,
none chosen; the default is repeated with more seeds on some of them. ``--sheet`` draws the first
ones from kept runs: the pose, the body, the result from two sides, and what the 2D model draws.
"""

import argparse
from collections.abc import Iterator
from pathlib import Path

import torch

from benchmarks.markdown import markdown
from benchmarks.quality import toybox
from benchmarks.quality import toybox_tables as tables
from benchmarks.quality.runs import rows_of
from benchmarks.quality.toybox_jobs import (
    GUIDANCE,
    RANDOM_STARTS,
    SAMPLES,
    TRUTH,
    WORLD,
    Variant,
    judge_of,
    prompts,
    setup,
    setup_of_samples,
)
from benchmarks.quality.toybox_options import BALL
from threestudio_gaussiandreamer import images

CHARTS = "avatars", "avatars_gpu"
CONFIG = "toybox-avatar.yaml"
VARIANTS = (
    Variant(TRUTH),
    Variant(SAMPLES, GUIDANCE),
    Variant(CONFIG, config=CONFIG),
    Variant(RANDOM_STARTS[0], 0, BALL, CONFIG),
    Variant("the body in grey", 0, {"system.geometry.prior.color": "grey"}, CONFIG),
    Variant("random start", 0, BALL | {"system.geometry.prior.color": "random"}, CONFIG),
)
"""The first three before the seeds of the third, and those before the others."""
PROMPTS, SEEDS, PROMPTS_OF_SEEDS = 40, range(5), 10
OF_PERSONS = ("action", "sides")
COLUMNS = [*toybox.COLUMNS[:-3], *OF_PERSONS, *toybox.COLUMNS[-3:]]
SHOWN = ("action", "sides", "colors", "accessory", "multi_face")
MISSED = {
    "action": "action",
    "sides": "side swapped",
    "colors": "colours",
    "accessory": "accessory",
}
CELLS = {"prior": ("pose", "body"), "result": ("result: {}", ""), "2D model": ("2D model",)}
"""The pictures of each of ``demo.STAGES`` on the sheet, by their texts."""
SHEET, PROMPTS_PER_ROW = 20, 2


def main() -> None:
    parser = toybox.argument_parser(__doc__)
    parser.add_argument("--sheet", type=Path, help="draw this picture of the runs of --keep")
    arguments = toybox.parsed(parser, CHARTS)
    arguments.columns = COLUMNS
    if arguments.sheet:
        draw_sheet(arguments)
    else:
        toybox.measure_missing(arguments, tasks(arguments))


def tasks(arguments: argparse.Namespace) -> Iterator[toybox.Task]:
    """Yield all tasks in order of priority."""
    common = arguments.models, arguments.keep, arguments.gpu
    for variants, seeds, count in (
        (VARIANTS[:3], SEEDS[:1], PROMPTS),
        (VARIANTS[2:3], SEEDS[1:], PROMPTS_OF_SEEDS),
        (VARIANTS[3:], SEEDS[:1], PROMPTS),
    ):
        for seed in seeds:
            for prompt in prompts("persons", count):
                for variant in variants:
                    yield toybox.Task(variant, prompt, seed, *common)


def draw_sheet(arguments: argparse.Namespace) -> None:
    """Draw the stages of the first prompts, with what the judge misses beneath."""
    from threestudio_gaussiandreamer.evaluation.asset_metrics import Scores
    from threestudio_gaussiandreamer.toybox.demo import contact_sheet, stages_of

    toybox.prepare()
    scores, pictures, texts = Scores(arguments.models), [], []
    for prompt in prompts("persons", SHEET):
        task = toybox.Task(VARIANTS[2], prompt, 0, arguments.models, arguments.keep)
        stages = stages_of(prompt.text, toybox.kept(task) / toybox.RUN, arguments.models, scores)
        for name, labels in CELLS.items():
            views, found = stages[name]
            missed = [text for key, text in MISSED.items() if found.get(key) == 0]
            ending = f"; missed: {', '.join(missed)}" if missed and name != "prior" else ""
            pictures += views[: len(labels)]
            texts += [f"{labels[0].format(prompt.text)}{ending}", *labels[1:]]
    columns = PROMPTS_PER_ROW * len(pictures) // SHEET
    images.write(arguments.sheet, contact_sheet(torch.stack(pictures), texts, columns=columns))
    print(arguments.sheet)


# ---- tables --------------------------------------------------------------------------------------


def table() -> str:
    """Return the table of reports/small_models.md."""
    known = (WORLD, setup_of_samples(), setup(config=CONFIG))
    rows = [
        row for row in rows_of(CHARTS[0]) if row["setup"] in known and row["judge"] == judge_of()
    ]
    if not rows:
        return tables.NOT_MEASURED
    heads = ["action", "sides kept", "colours", "accessory", "multi-face"]
    head = ("variant", "prompts", *(f"{name}, %" for name in heads), "Gaussians", "CPU seconds")
    lines = [line_of(name, same) for name, same in tables.variants(of_seeds(rows, {"0"}))]
    repeated = of_seeds(rows, set(map(str, SEEDS)))
    lines += [line_of(f"{name}, {len(SEEDS)} seeds", s) for name, s in tables.variants(repeated)]
    return markdown(head, lines)


def of_seeds(rows: list[tables.Row], seeds: set[str]) -> list[tables.Row]:
    """Return the rows of the variants and prompts that were run with all of these seeds."""
    made: dict[tuple[str, str], set[str]] = {}
    for row in rows:
        made.setdefault((row["variant"], row["prompt"]), set()).add(row["seed"])
    same = [row for row in rows if made[row["variant"], row["prompt"]] >= seeds]
    return [row for row in same if row["seed"] in seeds]


def line_of(name: str, rows: list[tables.Row]) -> list[str]:
    shares = [tables.percent(tables.estimate(rows, key)) for key in SHOWN]
    prompts = str(len({row["prompt"] for row in rows}))
    others = [tables.median_of(rows, key) for key in ("gaussians", "cpu_seconds")]
    return [name, prompts, *shares, *others]


if __name__ == "__main__":
    main()
