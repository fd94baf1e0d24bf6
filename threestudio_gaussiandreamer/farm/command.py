"""Make an asset for each prompt of a list, on all GPUs or cores of a Ray cluster or this machine:
``python -m threestudio_gaussiandreamer.farm prompts.txt --config gaussiandreamer.yaml``.

The same command goes on where it was after any kind of stop, and tries failed assets again. With
``--report`` it only writes the report of what there is."""

import argparse
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import datetime
from pathlib import Path
from typing import Any, Optional

from ..core.command import run_command
from ..core.launcher import train_alone
from ..core.signals import raised_signals
from ..launch.experiment import configure_logging
from ..launch.folder_lock import claim, require_writable
from ..launch.options import add_config, parse_with_overrides
from . import cluster
from .assets import Recipe
from .display import Display
from .driver import Driver
from .identity import require_farm, require_same_farm, require_same_recipe
from .ledger import FAILED, FINISHED, Ledger
from .recipe import check_recipe, jobs_left, make_recipe, root_of
from .remote_ledger import open_ledger
from .report import write_report
from .rows import check_rows, read_rows
from .storage import Place, is_url, place_of
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
    parser.add_argument(
        "--address",
        help="address of a Ray cluster, host:port or auto (default: start Ray on this machine)",
    )
    parser.add_argument(
        "--workers",
        type=whole(1),
        help="number of workers (default: as many as fit into the cluster)",
    )
    parser.add_argument(
        "--gpus",
        type=whole(0),
        help="number of GPUs, one per worker (default: all; 0: the CPU)",
    )
    parser.add_argument(
        "--cores", type=whole(1), default=1, help="CPU cores per worker (default: %(default)s)"
    )
    parser.add_argument(
        "--retries",
        type=whole(0),
        default=3,
        help="how often an asset is tried again after its worker has died (default: %(default)s)",
    )
    parser.add_argument(
        "--time-limit",
        type=positive,
        default=1800.0,
        help="seconds without a finished step after which an asset counts as hung (default: "
        "%(default)g)",
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
    place = place_of(args.out or f"{root or root_of(args.config)}/farm-{args.prompts.stem}")
    if args.report:
        require_farm(place)
        return report(args, place, open_ledger(place, only_read=True))
    if not is_url(str(place)):
        require_writable(place.folder, "--out" if args.out else "exp_root_dir")
    # before Ray starts: this takes a second
    recipe = make_recipe(args.config, overrides, cpu=True, cores=args.cores)
    recipe = check_recipe(recipe, read_rows(args.prompts))
    with claimed(place):
        require_same_recipe(place, recipe)
        ledger = open_ledger(place)
        done = sum(ledger.state(row) == FINISHED for row in read_rows(args.prompts))
        try:
            if done < total:
                with connected(args) as ray:
                    make_assets(args, ray, place, recipe, ledger, Display(total, done))
        finally:
            ledger.close()
    return report(args, place, ledger)


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
    ledger: Ledger,
    display: Display,
) -> None:
    """Start the workers and make all assets that are left."""
    resources = ray.cluster_resources()
    device = cluster.choose_device(resources, args.gpus, args.cores)
    count = cluster.count_workers(resources, device, args.gpus, args.workers)
    count = min(count, display.total - display.done)
    recipe = recipe._replace(cpu=not device.gpus)
    require_same_farm(place, recipe)
    cluster.require_same_version(ray)
    print(
        f"{display.total} assets, {display.done} finished; {count} workers with "
        f"{'1 GPU' if device.gpus else f'{device.cores} cores'} each; results in {place}",
        flush=True,
    )
    board = cluster.start_board(ray)
    session = datetime.now().isoformat()
    settings = [
        Setting(i, recipe, place, board, os.getcwd(), session, args.retries) for i in range(count)
    ]
    workers = cluster.start_workers(ray, settings, device)
    jobs = jobs_left(read_rows(args.prompts), ledger)
    Driver(ray, workers, settings, jobs, ledger, args.time_limit, display).run()


def report(args: argparse.Namespace, place: Place, ledger: Ledger) -> int:
    """Write the report; return 1 if assets have failed."""
    path = write_report(place, read_rows(args.prompts), ledger, args.price)
    states = [entry.state for entry in ledger.index.values()]
    counts = {state: states.count(i) for i, state in enumerate(("running", FINISHED, FAILED))}
    ledger.close()
    place_name = place if is_url(str(place)) else path
    print(f"{counts[FINISHED]} finished, {counts[FAILED]} failed; report: {place_name}")
    return 1 if counts[FAILED] else 0


@contextmanager
def claimed(place: Place) -> Iterator[None]:
    """Lock the farm's folder, or its scratch folder on this machine, against other commands."""
    folder = claim(place.folder, "another farm command is at work", ", or choose another --out")
    try:
        yield
    finally:
        folder.release()


@contextmanager
def connected(args: argparse.Namespace) -> Iterator[Any]:
    """Connect to Ray, and disconnect at the end, which ends the workers."""
    ray = cluster.connect(args.address)
    try:
        yield ray
    finally:
        ray.shutdown()
