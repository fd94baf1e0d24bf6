"""The tables of docs/toybox.md and reports/small_models.md, from docs/charts/toybox.csv and the
bundled models' record of their training.

Values are means over prompts with bootstrap intervals; several seeds of a prompt count as one.
Pattern and accessory are those of prompts that ask for one, since a plain object is easily right.
"""

import json
import math
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np

from benchmarks.markdown import markdown
from benchmarks.quality.chart_runs import grouped
from benchmarks.quality.runs import rows_of
from benchmarks.quality.toybox_jobs import (
    ATTRIBUTES,
    CHART,
    DEFAULT,
    EXACT,
    PAPER_RECIPE,
    RANDOM_STARTS,
    RECOGNIZED,
    SAMPLES,
    TRUTH,
    WORLD,
    judge_of,
    setup,
    setup_of_samples,
)
from threestudio_gaussiandreamer.evaluation.scorecard import Estimate, bootstrap, per_prompt
from threestudio_gaussiandreamer.models.bundled import FOLDER, RECORD
from threestudio_gaussiandreamer.toybox.words import attributes_in

TITLES = {"colors": "colours", "multi_face": "multi-face"}
HEAD = [f"{TITLES.get(name, name)}, %" for name in RECOGNIZED]
NOT_MEASURED = "*Not measured yet with the present models and configuration.*"
Row = dict[str, str]


# ---- numbers -------------------------------------------------------------------------------------


def asks_for(prompt: str, name: str) -> bool:
    """Return whether a prompt has what a column is about."""
    wanted = attributes_in(prompt)
    extra = wanted.accessory if wanted.action else wanted.part or wanted.accessory
    has = {"pattern": wanted.pattern != "plain", "accessory": extra}
    return bool(has.get(name, True))


def is_about(row: Row, name: str, prefix: str = "") -> bool:
    """Return whether a row has a value of a column, and its prompt what the column is about."""
    value = row[prefix + name]
    return bool(value) and not math.isnan(float(value)) and asks_for(row["prompt"], name)


def estimate(rows: Iterable[Row], name: str, prefix: str = "") -> Estimate:
    """Return the mean over prompts of a column, and its interval."""
    chosen = [row for row in rows if is_about(row, name, prefix)]
    values = np.array([float(row[prefix + name]) for row in chosen])
    means = per_prompt([row["prompt"] for row in chosen], values)
    return bootstrap(np.array(list(means.values()), float))


def percent(found: Estimate) -> str:
    """Return a share with its interval; empty where there are no values."""
    if math.isnan(found.mean):
        return ""
    low, middle, high = (f"{100 * value:.0f}" for value in (found.low, found.mean, found.high))
    return f"{middle} ({low} – {high})"


def median_of(rows: Sequence[Row], name: str, digits: int = 0) -> str:
    values = [float(row[name]) for row in rows if row[name]]
    return f"{np.median(values):.{digits}f}" if values else ""


def measured(chart: str = CHART) -> list[Row]:
    """Return the rows of withheld prompts."""
    return [row for row in rows_of(chart) if row["withheld"] == "1"]


def present() -> list[Row]:
    """Return those of the bundled models and of toybox.yaml as they are."""
    return [row for row in measured() if is_present(row)]


def is_present(row: Row) -> bool:
    """Return whether a row is of the present objects, models, or models and toybox.yaml, and by the
    present judge.
    """
    known = (WORLD, setup_of_samples(), setup())
    return row["setup"] in known and row["judge"] == judge_of()


def variants(rows: Iterable[Row]) -> Iterator[tuple[str, list[Row]]]:
    """Yield name and rows of each variant, in the order of their measurement."""
    yield from grouped(rows, title_of).items()


def title_of(row: Row) -> str:
    """Return the variant's name with the number that it varies, if any."""
    return row["variant"] if row["x"] == "0" else f"{row['variant']} {row['x']}"


# ---- tables --------------------------------------------------------------------------------------


def results() -> str:
    """Return the table of toybox.yaml, its prior's points, the paper's recipe, and references."""
    shown = (DEFAULT, EXACT, PAPER_RECIPE, TRUTH, SAMPLES, *RANDOM_STARTS)
    rows = [row for row in present() if row["variant"] in shown]
    if not rows:
        return NOT_MEASURED
    lines = []
    for name, same in variants(rows):
        lines.append(line_of(name, same))
        if name == DEFAULT:
            lines.append(line_of("its prior's points", same, "prior_"))
    table = markdown(("variant", "prompts", *HEAD, "haze, %", "Gaussians", "CPU seconds"), lines)
    return f"{table}\n\n{counts([row for row in rows if row['variant'] == DEFAULT])}"


def counts(rows: Sequence[Row]) -> str:
    """Return a sentence with the numbers of prompts that the columns are about."""
    prompts = {name: {row["prompt"] for row in rows if is_about(row, name)} for name in RECOGNIZED}
    return (
        f"Of the {len(prompts['kind'])} prompts of `{DEFAULT}`, {len(prompts['pattern'])} ask for "
        f"a pattern, {len(prompts['accessory'])} for an accessory or a coloured part, and "
        f"{len(prompts['multi_face'])} are of objects whose sides differ, which a multi-face rate "
        "needs."
    )


def seeds() -> str:
    """Return the results of toybox.yaml for each seed, on the prompts that were run with all."""
    rows = [row for row in present() if row["variant"] == DEFAULT]
    groups = grouped(rows, lambda row: row["seed"])
    if len(groups) < 2:
        return NOT_MEASURED
    common = set.intersection(*({row["prompt"] for row in rows} for rows in groups.values()))
    lines = [
        scores_of(seed, [row for row in rows if row["prompt"] in common])
        for seed, rows in sorted(groups.items())
    ]
    return markdown(("seed", "prompts", *HEAD), lines)


def summary() -> str:
    """Return kind / colours / pattern / accessory of toybox.yaml, in percent."""
    rows = [row for row in present() if row["variant"] == DEFAULT]
    means = [estimate(rows, name).mean for name in ATTRIBUTES]
    return " / ".join(f"{100 * mean:.0f}" for mean in means) if rows else NOT_MEASURED


def scores_of(name: str, rows: list[Row], prefix: str = "") -> list[str]:
    prompts = len({row["prompt"] for row in rows})
    return [name, str(prompts), *(percent(estimate(rows, key, prefix)) for key in RECOGNIZED)]


def line_of(name: str, rows: list[Row], prefix: str = "") -> list[str]:
    others = ["", "", ""]
    if not prefix:
        haze = [f"{100 * float(row['haze']):.1f}" for row in rows if row["haze"]]
        others[0] = f"{np.median(np.array(haze, float)):.1f}" if haze else ""
        others[1:] = [median_of(rows, "gaussians"), median_of(rows, "cpu_seconds")]
    return [*scores_of(name, rows, prefix), *others]


def card() -> str:
    """Return what each bundled network has seen, from the record of its training."""
    if not (FOLDER / RECORD).is_file():
        return "*No models are bundled yet.*"
    record = json.loads((FOLDER / RECORD).read_text(encoding="utf-8"))
    lines = [
        (f"`{name}`", f"{seen['images']:,}", trained(seen), withheld(seen["withheld"]))
        for name, seen in record.items()
    ]
    size = sum(path.stat().st_size for path in FOLDER.rglob("*") if path.is_file())
    head = ("network", "pictures or prompts seen", "trained for", "on withheld combinations")
    return f"{markdown(head, lines)}\n\nAll files together: {size / 1e6:.1f} MB."


def trained(seen: dict[str, Any]) -> str:
    """Return minutes and device of each of a network's trainings."""
    times = [f"{60 * part['hours']:.0f} min, {part['device']}" for part in seen["trainings"]]
    return "; then ".join(times)


def withheld(numbers: dict[str, Any]) -> str:
    return ", ".join(f"{name} {float(value):.3g}" for name, value in numbers.items())
