"""Train the toybox's models: ``python -m threestudio_gaussiandreamer.toybox.train FOLDER``.

Stages run in order, each up to its number of images, and go on from their checkpoints, so the same
command continues a training that was stopped anywhere. It runs unchanged on a GPU (``--device cuda
--precision bfloat16``).
"""

import argparse
import contextlib
import functools
import logging
import math
import os
import sys
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Optional

import torch

from ..core.command import run_command
from ..core.errors import UserError, unknown
from ..core.files import output_folder
from ..core.options import is_number, shown
from ..core.signals import interrupt
from ..launch.folder_lock import claim
from .autoencoder_stage import AutoencoderStage
from .checkpoints import is_trained
from .clip_stage import ClipStage
from .judge_stage import SEED_OFFSET, JudgeStage, judge_shards
from .loop import Options, Stage, Training
from .points_stage import PointsStage
from .text_stage import TextStage
from .unet_stage import SmallUNetStage, UNetStage
from .views import VIEWS, Shards
from .warm_start import start_from

STAGES: dict[str, type[Stage]] = {
    stage.name: stage
    for stage in (
        TextStage,
        ClipStage,
        AutoencoderStage,
        SmallUNetStage,
        UNetStage,
        PointsStage,
        JudgeStage,
    )
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
    add("--minutes", type=float, default=math.inf, help="a stage's end, if that comes earlier")
    add("--from-weights", type=Path, help="folder of toybox.export to start from")
    add("--seed", type=int, default=0)
    add("--device", default="cpu", help="cpu or cuda")
    add(
        "--precision",
        choices=["float32", "bfloat16"],
        default="float32",
        help="bfloat16: autocast, on a GPU or a CPU that multiplies it",
    )
    add("--threads", type=int, help="of torch")
    add("--batch", type=int, help="pictures of one step; default: the stage's own")
    add("--rate", type=float, help="learning rate; default: the stage's own")
    add("--only", default="", help="train parameters with this in their names; others stay fixed")
    add(
        "--pool",
        type=int,
        default=40,
        help="shards of 1024 pictures that a stage visits cyclically",
    )
    add(
        "--workers",
        type=int,
        default=0,
        help="processes that render all shards first and make the batches afterwards",
    )
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
    if args.only and len(args.stages) != 1:
        raise UserError(f"--only {args.only}: give the stage that it is for as --stages, e.g. unet")
    _require_numbers(args)
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {args.device}: PyTorch sees no GPU here; give cpu")
    devices = ["cpu", "cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if args.device not in devices:
        raise unknown("device", args.device, devices)
    return Options(
        folder=args.folder,
        seed=args.seed,
        device=args.device,
        pool=args.pool,
        precision=args.precision,
        rate=args.rate,
        only=args.only,
        batch=args.batch,
        workers=args.workers,
        save_seconds=60 * args.save_minutes,
        sheet_seconds=60 * args.sheet_minutes,
    )


def _require_numbers(args: argparse.Namespace) -> None:
    """Raise UserError for a number out of its range."""
    for name in ("images", "threads", "batch", "pool"):
        value = getattr(args, name)
        if value is not None and value < 1:
            raise UserError(f"--{name} {shown(value)}: expected at least 1")
    if not 0 <= args.seed < SEED_OFFSET:
        raise UserError(
            f"--seed {shown(args.seed)}: expected 0 to {SEED_OFFSET - 1}; larger seeds are of the "
            "objects that the judge learns from"
        )
    if UNetStage.name in args.stages and (args.batch or 0) > VIEWS and args.batch % VIEWS:
        raise UserError(
            f"--batch {args.batch}: most steps of {UNetStage.name} are of all {VIEWS} views of "
            f"objects: give a multiple of {VIEWS}, or less for single views"
        )
    if args.workers < 0:
        raise UserError(f"--workers {shown(args.workers)}: expected 0 or more")
    if args.rate is not None and not (is_number(args.rate) and args.rate > 0):
        raise UserError(f"--rate {args.rate}: expected more than 0")
    if not args.minutes > 0:
        raise UserError(f"--minutes {args.minutes}: expected more than 0")
    for name in ("save_minutes", "sheet_minutes"):
        if not is_number(getattr(args, name)) or getattr(args, name) < 0:
            option = f"--{name.replace('_', '-')}"
            raise UserError(f"{option} {getattr(args, name)}: expected minutes, 0 or more")


def render_shards(sorts: Sequence[Shards], count: int, workers: int) -> None:
    """Render the missing ones of the first ``count`` shards of each sort, in parallel."""
    jobs = [(shards, index) for shards in sorts for index in range(count)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(_render, jobs), 1):
            print(f"rendered {done}/{len(jobs)} shards", flush=True)


def _render(job: tuple[Shards, int]) -> None:
    shards, index = job
    shards.ensure(index)


def train(
    options: Options,
    stages: Sequence[str],
    images: Optional[int] = None,
    seconds: float = math.inf,
) -> None:
    """Train the stages in order, each until ``images`` were seen or ``seconds`` have passed.
    ``unet-small``, from which ``unet`` begins, is left out if that has begun.

    Raises:
        UserError: another process trains one of them in this folder.
        Terminated, KeyboardInterrupt: a signal stopped one, after it wrote its checkpoint.
    """
    for name in (name for name in STAGES if name in stages):
        if name == SmallUNetStage.name and is_trained(options.folder, UNetStage.name):
            print(f"{name}: not trained, since {UNetStage.name} has begun", flush=True)
            continue
        with locked(options.folder, name):
            training = Training(STAGES[name](options))
            progress = training.run(images, seconds)
        hours = progress.seconds / 3600
        print(f"{name}: {progress.images} images in {hours:.2f} hours", flush=True)
        if training.signum:
            interrupt(training.signum)


@contextlib.contextmanager
def locked(folder: Path, name: str) -> Iterator[None]:
    """Let no other process train this stage in this folder meanwhile: their checkpoints would
    replace each other's.

    Raises:
        UserError: another process trains it.
    """
    busy = f"another process trains the stage {name!r}"
    claimed = claim(folder / "locks" / name, busy, ", or give another folder")
    try:
        yield
    finally:
        claimed.release()


def run(args: argparse.Namespace) -> None:
    """Check the options, and train.

    Raises:
        UserError: an option is invalid, or a file can't be written or doesn't fit.
        Terminated, KeyboardInterrupt: a signal stopped the training; a checkpoint is written.
    """
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    options = options_of(args)
    output_folder(options.folder, "FOLDER")
    if args.threads:
        torch.set_num_threads(args.threads)
    if args.workers:
        of_judge = judge_shards(options) if JudgeStage.name in args.stages else ()
        workers = min(args.workers, os.cpu_count() or 1)
        render_shards([options.shards(), *of_judge], options.pool, workers)
    if args.from_weights:
        start_from(args.from_weights, options, STAGES)
    train(options, args.stages, args.images, 60 * args.minutes)


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
