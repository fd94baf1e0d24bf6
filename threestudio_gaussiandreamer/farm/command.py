"""Make an asset for each prompt of a list, on all GPUs or cores of a Ray cluster or this machine:
``python -m threestudio_gaussiandreamer.farm prompts.txt --config gaussiandreamer.yaml``."""

import argparse
import os
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path
from typing import Optional

from ..core.command import run_command
from ..core.errors import UserError
from ..core.launcher import train_alone
from ..core.options import RULE, at_least, positive
from ..launch.experiment import configure_logging
from ..launch.options import add_config, parse_with_overrides
from ..launch.run_folder import claim, require_writable
from . import driver
from .board import Board
from .place import FAILED, FINISHED, Place
from .recipe import FARM, Recipe, check_recipe, read_config, require_same_farm, root_of, unfinished
from .report import write_report
from .rows import check_rows, read_rows
from .worker import Setting

RULES = {
    **{"price": positive(), "time_limit": positive("seconds"), "workers": at_least(1)},
    **{"gpus": at_least(0), "cores": at_least(1), "retries": at_least(0)},
}
"""Of the numeric options."""


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Return the exit code: 0, or 1 if some aren't finished (``--report``: have failed)."""
    return run_command(parse_arguments, run_farm, argv)


def parse_arguments(argv: Optional[Sequence[str]] = None) -> argparse.Namespace:
    """Parse the command line; all arguments ``key=value`` are overrides."""
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.farm",
        description="Make an asset for each prompt of a list.",
        epilog="Everything else is an override of the configuration: trainer.max_steps=600",
        allow_abbrev=False,
    )
    add = parser.add_argument
    add("prompts", type=Path, help="a list of prompts: .txt, .csv or .jsonl")
    add_config(parser)
    add("--out", help="folder, or URL such as s3://bucket/farm (default: in exp_root_dir)")
    add("--report", action="store_true", help="only write the report")
    add("--price", type=float, help="cost of one worker-hour, for the report")
    add("--address", help="of a Ray cluster, host:port or auto (default: start Ray here)")
    add("--workers", type=int, help="number of workers (default: as many as fit)")
    add("--gpus", type=int, help="number of GPUs, one per worker (default: all; 0: the CPU)")
    cores = "CPU cores per worker (default: %(default)s)"
    add("--cores", type=int, default=1, help=cores)
    retries = "how often an asset is tried again after its worker has died (default: %(default)s)"
    add("--retries", type=int, default=3, help=retries)
    limit = "seconds without a step after which an asset counts as hung (default: %(default)g)"
    add("--time-limit", type=float, default=1800.0, help=limit)
    return parse_with_overrides(parser, argv)


def run_farm(args: argparse.Namespace) -> int:
    """Make the assets, or only the report, and return the exit code."""
    train_alone()  # whatever has started this process, such as a job of SLURM
    configure_logging(verbose=False)
    for name, rule in RULES.items():
        if (value := getattr(args, name)) is not None:
            rule[RULE](f"--{name.replace('_', '-')}", value)
    total = check_rows(args.prompts)
    roots = [text for text in args.overrides if text.startswith("exp_root_dir=")]
    root = roots[-1].partition("=")[2] if roots else args.out or root_of(args.config)
    place = Place(args.out or f"{root}/farm-{args.prompts.stem}")
    if not args.report:
        if not place.remote:
            require_writable(place.folder, "--out" if args.out else "exp_root_dir")
        # before Ray starts: this takes a second
        overrides = tuple(text for text in args.overrides if text not in roots)
        recipe = Recipe(tuple(map(read_config, args.config)), overrides, True, args.cores)
        recipe = check_recipe(recipe, read_rows(args.prompts))
        require_same_farm(place, recipe, before_ray=True)
        lock = claim(place.folder, "another farm command is at work", ", or choose another --out")
        try:
            make_assets(args, place, recipe, total)
        finally:
            lock.release()
    elif place.read_json(FARM) == [None]:
        raise UserError(f"there is no farm in {place}: it has no {FARM}; check --out")
    path, states = write_report(place, read_rows(args.prompts), total, args.price)
    where = place if place.remote else path
    print(f"{states[FINISHED]} finished, {states[FAILED]} failed; report: {where}")
    return int(states[FAILED] > 0 or not args.report and states[FINISHED] < total)


def make_assets(args: argparse.Namespace, place: Place, recipe: Recipe, total: int) -> None:
    """Start Ray and the workers, and make all assets that are left."""
    finished, jobs = unfinished(place, args.prompts, total)
    if finished == total:
        return
    ray = driver.connect(args.address)
    try:
        there = ray.cluster_resources()
        count, gpus = driver.plan_workers(there, args.gpus, args.cores, args.workers)
        count, recipe = min(count, total - finished), recipe._replace(cpu=not gpus)
        require_same_farm(place, recipe)
        each = f"{count} workers with {'1 GPU' if gpus else f'{args.cores} cores'} each"
        print(f"{total} assets, {finished} finished; {each}; results in {place}", flush=True)
        board = ray.remote(num_cpus=0, max_restarts=-1)(Board).remote()
        session = datetime.now().isoformat()
        setting = Setting(recipe, place, board, os.getcwd(), session, args.retries)
        workers = driver.start_workers(ray, count, gpus, setting)
        driver.Driver(ray, workers, setting, jobs, args.time_limit, total, finished).run()
    finally:
        ray.shutdown()  # which ends the workers
