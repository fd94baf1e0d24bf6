"""Train the toybox's models: ``python -m threestudio_gaussiandreamer.toybox.train FOLDER``.

Stages run in order, each up to its number of images, and go on from their checkpoints, so the same
command continues a training that was stopped anywhere. It runs unchanged on a GPU (``--device cuda
--precision bfloat16``).
"""

import argparse
import logging
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Optional

import torch

from ..core.errors import UserError, unknown
from .autoencoder_stage import AutoencoderStage
from .clip_stage import ClipStage
from .judge_stage import SEED_OFFSET, JudgeStage
from .loop import Options, Stage, Training
from .points_stage import PointsStage
from .unet_stage import UNetStage
from .views import Shards
from .warm_start import start_from

STAGES: dict[str, type[Stage]] = {
    stage.name: stage for stage in (ClipStage, AutoencoderStage, UNetStage, PointsStage, JudgeStage)
}
"""In the order of training: later ones need earlier ones."""


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.train", description="Train the toybox's models."
    )
    add = parser.add_argument
    add(
        "folder", type=Path, help="pictures, checkpoints, curves and sheets; continued if it exists"
    )
    add("--stages", nargs="+", default=list(STAGES), help=f"of {', '.join(STAGES)}; default: all")
    add("--images", type=int, help="a stage's end; default: its own number of pictures")
    add("--from-weights", type=Path, help="folder of toybox.export to start from")
    add("--seed", type=int, default=0)
    add("--device", default="cpu", help="cpu or cuda")
    add(
        "--precision",
        choices=["float32", "bfloat16"],
        default="float32",
        help="bfloat16: autocast, on a GPU",
    )
    add("--threads", type=int, help="of torch")
    add("--batch", type=int, help="pictures of one step; default: the stage's own")
    add(
        "--pool",
        type=int,
        default=40,
        help="shards of 1024 pictures that a stage visits cyclically",
    )
    add("--workers", type=int, default=0, help="processes that render all shards first")
    add("--save-minutes", type=float, default=5.0)
    add("--sheet-minutes", type=float, default=20.0)
    return parser.parse_args(argv)


def options_of(args: argparse.Namespace) -> Options:
    """Return the checked options.

    Raises:
        UserError: an unknown stage, a number out of range, or no such device.
    """
    for name in args.stages:
        if name not in STAGES:
            raise unknown("stage", name, STAGES)
    for name in ("images", "threads", "batch", "pool"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise UserError(f"--{name} {value}: expected at least 1")
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {args.device}: PyTorch sees no GPU here; give cpu")
    return Options(
        folder=args.folder,
        seed=args.seed,
        device=args.device,
        pool=args.pool,
        precision=args.precision,
        batch=args.batch,
        save_seconds=60 * args.save_minutes,
        sheet_seconds=60 * args.sheet_minutes,
    )


def render_shards(options: Options, seeds: Sequence[int], workers: int) -> None:
    """Render all missing shards of these seeds in ``workers`` processes."""
    jobs = [(options, seed, index) for seed in seeds for index in range(options.pool)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for count, _ in enumerate(pool.map(_render, jobs), 1):
            print(f"rendered {count}/{len(jobs)} shards", flush=True)


def _render(job: tuple[Options, int, int]) -> None:
    options, seed, index = job
    Shards(options.shards_folder(), seed, objects=options.shard_objects).ensure(index)


def train(options: Options, stages: Sequence[str], images: Optional[int] = None) -> None:
    """Train the stages in order."""
    for name in STAGES:
        if name in stages:
            progress = Training(STAGES[name](options)).run(images)
            print(
                f"{name}: {progress.images} images in {progress.seconds / 3600:.2f} hours",
                flush=True,
            )


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line; returns the exit code: 0 done, 2 an error that the user can correct."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        args = parse(argv)
        options = options_of(args)
        if args.threads:
            torch.set_num_threads(args.threads)
        if args.workers:
            seeds = [options.seed] + [options.seed + SEED_OFFSET] * ("judge" in args.stages)
            render_shards(options, seeds, min(args.workers, os.cpu_count() or 1))
        if args.from_weights:
            start_from(args.from_weights, options, STAGES)
        train(options, args.stages, args.images)
    except SystemExit as stop:
        return int(stop.code or 0)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())
