"""Score finished assets and compare two folders of them.

``python -m threestudio_gaussiandreamer.evaluate FOLDER [FOLDER ...] --metrics clip,judge,janus
[--clip FOLDER] [--against FOLDER]``

A folder is that of one run, or holds the folders of runs at any depth. ``scorecard.csv`` has a row
for each asset. ``scorecard.json`` has the means over the prompts with their bootstrap intervals;
with ``--against`` it also has the paired differences over the prompts that both sides have.
``asset_metrics.py`` lists the metrics.
"""

import argparse
import csv
import functools
import io
import os
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, Optional

import numpy as np
from tqdm import tqdm

from .. import register_parts
from ..core.command import run_command
from ..core.errors import UserError, unknown
from ..core.files import atomic_file, json_text, output_folder
from ..core.options import shown
from ..models.bundled import NAME
from ..training.camera_options import MAX_SIDE
from .asset_metrics import METRICS, Asset, Metric
from .clip_similarity import Protocol, has_own_cameras
from .image_reward import SOURCES
from .intervals import Estimate, bootstrap, paired, per_prompt
from .results import Result, find_result, read_result

FILES = ("scorecard.csv", "scorecard.json")
Rows = list[dict[str, Any]]


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
    """Check files, prompts and output, then score all assets and write the scorecard.

    Raises:
        UserError: also if an asset can't be scored, after the scorecard of the others is written.
    """
    register_parts()
    metrics, failed = open_metrics(args), []
    first = find_results(args.folders, failed)
    second = find_results([args.against], failed) if args.against else []
    output = output_folder(args.output, "--output", FILES)
    rows = [list(scored(results, metrics, failed)) for results in (first, second)]
    if rows[0]:
        content = summary(metrics, *rows)
        write(output, rows[0] + rows[1], content)
        notes = [line for metric in metrics for line in without_value(metric, rows[0] + rows[1])]
        print("\n".join([*table(content), *notes, str(output / "scorecard.csv")]))
    if failed:
        raise UserError(f"{len(failed)} of the assets can't be scored: {'; '.join(failed)}")


def open_metrics(args: argparse.Namespace) -> list[Metric]:
    """Load the metrics of ``--metrics``.

    Raises:
        UserError: a name isn't known, or a file that a metric needs is missing.
    """
    names = [name.strip() for name in args.metrics.split(",") if name.strip()]
    for name in names:
        if name in NOT_LOCAL:
            raise UserError(f"--metrics {name}: {NOT_LOCAL[name]}")
        if name not in METRICS:
            raise unknown("metric", name, METRICS)
    if not names:
        raise UserError(f"--metrics is empty: expected some of {', '.join(METRICS)}")
    if args.size is not None and not 1 <= args.size <= MAX_SIDE:
        raise UserError(f"--size {shown(args.size)}: expected 1 to {MAX_SIDE} pixels")
    for name in names:
        require_models(name, args)
    if args.size is not None and not any(has_size(name, args.clip) for name in names):
        raise UserError("--size has no effect on these metrics, whose pictures have their own size")
    args.size = Protocol().size if args.size is None else args.size
    return [METRICS[name](args) for name in names]


def has_size(name: str, clip: Optional[str]) -> bool:
    """Return whether ``--size`` is that of a metric's pictures; the toybox's CLIP has its own."""
    return name == "imagereward" or name in ("clip", "directions") and not has_own_cameras(clip)


NOT_LOCAL = {
    "alignment": "T3Bench's alignment is the answer of GPT-4, a service without weights to load; "
    "clip_similarity --t3bench FOLDER writes what its own scripts read (docs/evaluation.md)"
}
"""Metrics that can't be computed here, and why."""


def require_models(name: str, args: argparse.Namespace) -> None:
    """Raise UserError unless the folder of models that a metric needs is given."""
    if name in ("clip", "directions") and not args.clip:
        raise UserError(
            f"--metrics {name} needs --clip FOLDER, for instance after `hf download "
            "openai/clip-vit-large-patch14 --local-dir clip`"
        )
    if name in ("imagereward", "quality") and not args.imagereward:
        commands = " and ".join(f"`{line} --local-dir ir`" for line in SOURCES.values())
        raise UserError(f"--metrics {name} needs --imagereward FOLDER, after {commands}")


def find_results(folders: Sequence[str], failed: list[str]) -> list[Result]:
    """Find the finished runs in these folders, sorted by path; a run in several of them once.

    Args:
        failed: gets the messages of runs without a file of Gaussians.

    Raises:
        UserError: a folder doesn't exist or holds no finished run.
    """
    found: dict[Path, Optional[Result]] = {}
    for folder in folders:
        if not Path(folder).expanduser().is_dir():
            raise UserError(f"{folder!r} is no folder: expected a run's, or one that holds runs")
        runs = list(run_folders(Path(folder).expanduser()))
        if not runs:
            raise UserError(f"{folder!r} holds no finished run, which has a save/it*-export folder")
        for place in runs:
            if place.resolve() in found:
                continue
            found[place.resolve()] = None
            try:
                found[place.resolve()] = find_result(str(place))
            except UserError as error:
                failed.append(str(error))
    return [result for result in found.values() if result]


def run_folders(folder: Path) -> Iterator[Path]:
    """Yield the folders of finished runs below a folder, also behind links; runs inside runs aren't
    searched.
    """
    seen = set()
    for place, names, _ in os.walk(folder, followlinks=True):
        names.sort()
        if (real := os.path.realpath(place)) in seen:  # a link to a folder above
            names.clear()
            continue
        seen.add(real)
        if any(Path(place).glob("save/it*-export")):
            names.clear()
            yield Path(place)


def scored(
    results: Sequence[Result], metrics: Sequence[Metric], failed: list[str]
) -> Iterator[dict[str, Any]]:
    """Yield a row of the table for each result.

    Args:
        failed: gets the messages of those that can't be read or scored.
    """
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


def summary(metrics: Sequence[Metric], first: Rows, second: Rows) -> dict[str, Any]:
    """Return the content of ``scorecard.json``."""

    def prompt_means(rows: Rows, column: str) -> dict[str, float]:
        values = np.array([row[column] for row in rows], float)
        return per_prompt([row["prompt"] for row in rows], values)

    def estimate(means: dict[str, float]) -> Estimate:
        return bootstrap(np.array(list(means.values()), float))

    content: dict[str, Any] = {}
    for column in (name for metric in metrics for name in metric.columns):
        means = [prompt_means(rows, column) for rows in (first, second)]
        entry = {"mean": estimate(means[0])}
        if second:
            entry |= {"against": estimate(means[1]), "difference": paired(*means)}
        content[column] = {name: value._asdict() for name, value in entry.items()}
    return content


def write(output: Path, rows: Rows, content: dict[str, Any]) -> None:
    """Write ``scorecard.csv`` and ``scorecard.json``."""
    text = io.StringIO()
    writer = csv.DictWriter(text, list(rows[0]), lineterminator="\n")
    writer.writeheader()
    writer.writerows(rows)
    for name, body in zip(FILES, (text.getvalue(), json_text(content, indent=2)), strict=True):
        with atomic_file(output / name) as file:
            file.write(body.encode(errors="surrogateescape"))  # paths may hold invalid UTF-8


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
