"""Make an asset for each prompt of a list, on all GPUs or cores of a Ray cluster or this machine:
``python -m threestudio_gaussiandreamer.farm prompts.txt --config gaussiandreamer.yaml``.

The same command goes on where it was after any kind of stop, and tries failed assets again. With
``--report`` it only writes the report of what there is."""

import argparse
import os
from collections.abc import Iterator, Sequence
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

from tqdm import tqdm

from ..core.command import run_command
from ..core.errors import UserError
from ..core.launcher import train_alone
from ..core.signals import raised_signals
from ..launch.experiment import configure_logging
from ..launch.folder_lock import require_writable
from ..launch.options import add_config, parse_with_overrides
from . import cluster
from .board import Board
from .driver import Driver
from .place import FAILED, FINISHED, Place, adopt_ledger, claimed, is_url
from .recipe import FARM, Job, Recipe, check_recipe, job_of, make_recipe, require_same_farm, root_of
from .report import write_report
from .rows import check_rows, read_rows
from .worker import Setting

PROGRAM = "python -m threestudio_gaussiandreamer.farm"


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line and return the exit code: 0 if all assets are finished, 1 if some have
    failed, 2 for invalid input, 130 for Ctrl-C.
    """
    codes = [0]

    def run(args: argparse.Namespace) -> None:
        with raised_signals():
            codes[0] = run_farm(args)

    return run_command(parse_arguments, run, argv) or codes[0]


# Arguments
# --------------------------------------------------------------------------------------------------


def parse_arguments(argv: Optional[Sequence[str]] = None) -> argparse.Namespace:
    """Parse the command line; all arguments ``key=value`` are overrides."""
    parser = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Make an asset for each prompt of a list.",
        epilog="Everything else is an override of the configuration: trainer.max_steps=600",
        allow_abbrev=False,
    )
    parser.add_argument("prompts", type=Path, help="a list of prompts: .txt, .csv or .jsonl")
    add_config(parser)
    parser.add_argument(
        "--out",
        help="the farm's folder, or a URL such as s3://bucket/farm (default: "
        "farm-<prompts> in exp_root_dir)",
    )
    parser.add_argument("--report", action="store_true", help="only write the report")
    parser.add_argument("--price", type=positive, help="cost of one worker-hour, for the report")
    _add_cluster_options(parser)
    return parse_with_overrides(parser, argv)


def _add_cluster_options(parser: argparse.ArgumentParser) -> None:
    add = parser.add_argument
    add("--address", help="of a Ray cluster, host:port or auto (default: start Ray here)")
    add("--workers", type=whole(1), help="number of workers (default: as many as fit)")
    add("--gpus", type=whole(0), help="number of GPUs, one per worker (default: all; 0: the CPU)")
    add("--cores", type=whole(1), default=1, help="CPU cores per worker (default: %(default)s)")
    add(
        "--retries",
        type=whole(0),
        default=3,
        help="how often an asset is tried again after its worker has died (default: %(default)s)",
    )
    add(
        "--time-limit",
        type=positive,
        default=1800.0,
        help="seconds without a step after which an asset counts as hung (default: %(default)g)",
    )


def whole(low: int) -> Any:
    def parse(text: str) -> int:
        if not text.isdigit() or int(text) < low:
            raise argparse.ArgumentTypeError(f"expected a whole number from {low}, got {text!r}")
        return int(text)

    return parse


def positive(text: str) -> float:
    """Parse a finite number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text!r}")
    return value


# The farm
# --------------------------------------------------------------------------------------------------


def run_farm(args: argparse.Namespace) -> int:
    """Make the assets, or only the report, and return the exit code."""
    train_alone()  # whatever has started this process, such as a job of SLURM
    configure_logging(verbose=False)
    total = check_rows(args.prompts)
    root, overrides = split_root(args.overrides)
    place = Place(args.out or f"{root or root_of(args.config)}/farm-{args.prompts.stem}")
    if args.report:
        if place.json(FARM) is None:
            raise UserError(f"there is no farm in {place}: it has no {FARM}; check --out")
        adopt_ledger(place)
        return report(args, place, total)
    if not is_url(str(place)):
        require_writable(place.folder, "--out" if args.out else "exp_root_dir")
    # before Ray starts: this takes a second
    recipe = make_recipe(args.config, overrides, cpu=True, cores=args.cores)
    recipe = check_recipe(recipe, read_rows(args.prompts))
    require_same_farm(place, recipe, before_ray=True)
    adopt_ledger(place)
    with claimed(place):
        finished: set[int] = set()
        spent: dict[int, float] = {}
        rows = place.records(read_rows(args.prompts))
        for row, record in tqdm(rows, "records", total, unit="asset", disable=None, delay=1):
            if record["state"] == FINISHED:
                finished.add(row.line)
            elif "worker_seconds" in record:
                spent[row.line] = record["worker_seconds"]
        jobs = (
            job_of(row, spent.get(row.line, 0.0))
            for row in read_rows(args.prompts)
            if row.line not in finished
        )
        if len(finished) < total:
            ray = cluster.connect(args.address)
            try:
                make_assets(args, ray, place, recipe, jobs, total, len(finished))
            finally:
                ray.shutdown()  # which ends the workers
    return report(args, place, total)


def split_root(overrides: Sequence[str]) -> tuple[Optional[str], list[str]]:
    """Return the value of ``exp_root_dir``, in which the farm's folder lies, and the others."""
    roots = [text for text in overrides if text.startswith("exp_root_dir=")]
    others = [text for text in overrides if text not in roots]
    return roots[-1].partition("=")[2] if roots else None, others


def make_assets(
    args: argparse.Namespace,
    ray: Any,
    place: Place,
    recipe: Recipe,
    jobs: Iterator[Job],
    total: int,
    done: int,
) -> None:
    """Start the workers and make all assets that are left."""
    resources = ray.cluster_resources()
    device = cluster.choose_device(resources, args.gpus, args.cores)
    count = cluster.count_workers(resources, device, args.gpus, args.workers)
    count = min(count, total - done)
    recipe = recipe._replace(cpu=not device.gpus)
    require_same_farm(place, recipe)
    cluster.require_same_version(ray)
    print(
        f"{total} assets, {done} finished; {count} workers with "
        f"{'1 GPU' if device.gpus else f'{device.cores} cores'} each; results in {place}",
        flush=True,
    )
    board = ray.remote(num_cpus=0, max_restarts=-1)(Board).remote()
    session = datetime.now().isoformat()
    settings = [
        Setting(i, recipe, place, board, os.getcwd(), session, args.retries) for i in range(count)
    ]
    workers = cluster.start_workers(ray, settings, device)
    Driver(ray, workers, settings, jobs, args.time_limit, total, done).run()


def report(args: argparse.Namespace, place: Place, total: int) -> int:
    """Write the report; return 1 if assets have failed."""
    path, states = write_report(place, read_rows(args.prompts), total, args.price)
    where = place if is_url(str(place)) else path
    print(f"{states[FINISHED]} finished, {states[FAILED]} failed; report: {where}")
    return 1 if states[FAILED] else 0
