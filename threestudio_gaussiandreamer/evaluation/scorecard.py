"""Score finished assets and compare two folders of them:
``python -m threestudio_gaussiandreamer.evaluate FOLDER ... --metrics clip,judge,janus``"""

import argparse
import csv
import functools
import io
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
from jaxtyping import Float
from tqdm import tqdm

from .. import register_parts
from ..core.command import run_command
from ..core.errors import UserError, unknown
from ..core.files import json_text, output_folder, write_file
from ..core.options import RULE
from ..core.streams import numpy_generator
from ..models.bundled import NAME
from .asset_metrics import METRICS, Asset, Metric
from .clip_similarity import PIXELS, Protocol, has_own_cameras
from .results import Result, find_result, read_result

FILES = ("scorecard.csv", "scorecard.json")
DRAWS, LEVEL = 2000, 0.95
"""Of the bootstrap: samples, and level of the intervals."""
Rows = list[dict[str, Any]]


class Estimate(NamedTuple):
    """A mean with its interval, NaN where there are no values, and the number of prompts."""

    mean: float
    low: float
    high: float
    count: int


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.evaluate",
        description="Score finished assets by their renders and prompts.",
    )
    add = parser.add_argument
    add("folders", nargs="+", metavar="FOLDER", help="a run's folder, or one that holds runs")
    add("--metrics", default="clip", help=f"comma-separated, of {', '.join(METRICS)}")
    add("--against", metavar="FOLDER", help="also score these runs, and print paired differences")
    clip = "folder of a CLIP in transformers' format, or toybox (bundled): clip, directions"
    add("--clip", help=clip)
    add("--imagereward", help="folder with ImageReward.pt and vocab.txt, for imagereward, quality")
    add("--judge", default=NAME, help="model of judge and janus: a file, or toybox (bundled)")
    size = "width and height of the pictures for clip, directions and imagereward, pixels"
    add("--size", type=int, help=f"{size} (default: {Protocol().size})")
    add("--output", default="evaluation", help="folder for scorecard.csv and scorecard.json")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Score all assets and write the scorecard; what can't be scored is an error after it."""
    register_parts()
    metrics, failed = open_metrics(args), []
    first = find_results(args.folders, failed)
    second = find_results([args.against], failed) if args.against else []
    output = output_folder(args.output, "--output", FILES)
    rows = [list(scored(results, metrics, failed)) for results in (first, second)]
    if rows[0]:
        content = summary(*rows)
        write(output, rows[0] + rows[1], content)
        notes = [line for metric in metrics for line in without_value(metric, rows[0] + rows[1])]
        print("\n".join([*table(content), *notes, str(output / "scorecard.csv")]))
    if failed:
        raise UserError(f"{len(failed)} of the assets can't be scored: {'; '.join(failed)}")


def open_metrics(args: argparse.Namespace) -> list[Metric]:
    """Load the metrics of ``--metrics``."""
    names = [name.strip() for name in args.metrics.split(",") if name.strip()]
    if not names:
        raise UserError(f"--metrics is empty: expected some of {', '.join(METRICS)}")
    if args.size is not None:
        PIXELS[RULE]("--size", args.size)
    for name in names:
        if name not in METRICS:
            raise unknown("metric", name, METRICS)
        option, *commands = METRICS[name].needs or ("judge",)
        if not getattr(args, option):
            after = " and ".join(commands)
            raise UserError(f"--metrics {name} needs --{option} FOLDER, after {after}")
    own = "clip" if has_own_cameras(args.clip) else None  # whose size the toybox's CLIP determines
    sized = [METRICS[name] for name in names if METRICS[name].sized]
    if args.size is not None and all(metric.needs[0] == own for metric in sized):
        raise UserError("--size has no effect on these metrics, whose pictures have their own size")
    args.size = args.size or Protocol().size
    return [METRICS[name](args) for name in names]


def find_results(folders: Sequence[str], failed: list[str]) -> list[Result]:
    """Find the finished runs in folders, each once; ``failed`` gets messages about others."""
    places: dict[Path, str] = {}
    for folder in folders:
        runs = list(run_folders(Path(folder).expanduser()))
        if not runs:
            raise UserError(f"{folder!r} holds no finished runs, which have a save/it*-export")
        for run in runs:
            places.setdefault(run.resolve(), str(run))
    results = []
    for place in places.values():
        try:
            results.append(find_result(place))
        except UserError as error:
            failed.append(str(error))
    return results


def run_folders(folder: Path) -> Iterator[Path]:
    """Yield the folders of finished runs below a folder; runs inside runs aren't searched."""
    seen = set()
    for place, names, _ in os.walk(folder, followlinks=True):
        real, found = os.path.realpath(place), any(Path(place).glob("save/it*-export"))
        if found and real not in seen:
            yield Path(place)
        # behind a link to a folder above is nothing new
        names[:] = [] if found or real in seen else sorted(names)
        seen.add(real)


def scored(
    results: Sequence[Result], metrics: Sequence[Metric], failed: list[str]
) -> Iterator[dict[str, Any]]:
    """Yield a row of the table for each result; ``failed`` gets the messages of the others."""
    for item, result in enumerate(tqdm(results, unit="asset", disable=None)):
        row: dict[str, Any] = {"asset": str(result.file.parents[2])}
        try:
            if not result.prompt:
                raise UserError(f"{str(result.file)!r} has no prompt in configs/parsed.yaml")
            row["prompt"] = result.prompt
            asset = Asset(result, row["prompt"], read_result(result), item)
            for metric in metrics:
                row |= metric.score(asset)
        except UserError as error:
            failed.append(str(error))
        else:
            yield row


# ---- means over prompts with confidence intervals -----------------------------------------------


def bootstrap(values: Float[np.ndarray, " N"], *, seed: int = 0) -> Estimate:
    """Return the mean and its percentile bootstrap interval (Efron 1979) of level LEVEL of values,
    one for each prompt, without NaN, where the metric isn't defined.
    """
    values = values[~np.isnan(values)]
    if not len(values):
        return Estimate(np.nan, np.nan, np.nan, 0)
    rows = numpy_generator(seed, "bootstrap").integers(len(values), size=(DRAWS, len(values)))
    low, high = np.quantile(values[rows].mean(axis=1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Estimate(float(values.mean()), float(low), float(high), len(values))


def per_prompt(prompts: list[str], values: Float[np.ndarray, " N"]) -> dict[str, float]:
    """Return the mean over the results of each prompt; NaNs are left out."""
    groups: dict[str, list[float]] = {prompt: [] for prompt in prompts}
    for prompt, value in zip(prompts, values, strict=True):
        if not np.isnan(value):
            groups[prompt].append(float(value))
    return {prompt: float(np.mean(v)) if v else float("nan") for prompt, v in groups.items()}


def paired(first: dict[str, float], second: dict[str, float], *, seed: int = 0) -> Estimate:
    """Return the mean of first minus second over the prompts that both have."""
    common = [prompt for prompt in first if prompt in second]
    return bootstrap(np.array([first[p] - second[p] for p in common], float), seed=seed)


def columns_of(rows: Rows) -> list[str]:
    """Return the columns of all rows: those of persons are in theirs only."""
    return list(dict.fromkeys(name for row in rows for name in row))


def summary(first: Rows, second: Rows) -> dict[str, Any]:
    """Return the content of ``scorecard.json``."""
    content: dict[str, Any] = {}
    for column in columns_of(first + second)[2:]:  # after asset and prompt
        means = [
            per_prompt(
                [row["prompt"] for row in rows], np.array([row.get(column, np.nan) for row in rows])
            )
            for rows in (first, second)
        ]
        own, other = (bootstrap(np.array(list(mean.values()), float)) for mean in means)
        entry = {"mean": own}
        if second:
            entry |= {"against": other, "difference": paired(*means)}
        content[column] = {name: value._asdict() for name, value in entry.items()}
    return content


def write(output: Path, rows: Rows, content: dict[str, Any]) -> None:
    """Write ``scorecard.csv`` and ``scorecard.json``."""
    text = io.StringIO()
    writer = csv.DictWriter(text, columns_of(rows), restval="nan", lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    for name, body in zip(FILES, (text.getvalue(), json_text(content, indent=2)), strict=True):
        write_file(output / name, body)


def table(content: dict[str, Any]) -> list[str]:
    """Return the lines to print: mean, interval and number of prompts of each column."""
    lines = []
    for column, entries in content.items():
        for name, value in entries.items():
            label = column if name == "mean" else f"  {name}"
            interval = f"[{value['low']:.3f}, {value['high']:.3f}]"
            lines.append(f"{label:<18} {value['mean']:8.3f} {interval:>20} n={value['count']}")
    return lines


def without_value(metric: Metric, rows: Rows) -> Iterator[str]:
    """Yield a line about the prompts for which a metric isn't defined, if there are any."""
    found = {row["prompt"]: None for row in rows if all(np.isnan(row[c]) for c in metric.columns)}
    if found:
        first = "; ".join(repr(prompt) for prompt in list(found)[:3])
        yield (
            f"{', '.join(metric.columns)}: no value for {len(found)} of the prompts ({first}"
            f"{', ...' if len(found) > 3 else ''}): {metric.undefined}"
        )


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
