"""Train the toybox's models: ``python -m threestudio_gaussiandreamer.toybox.train FOLDER``.

Stages run in order, each up to its number of images, and go on from their checkpoints, so the same
command continues a training that was stopped anywhere. It runs unchanged on a GPU (``--device cuda
--precision bfloat16``).
"""

import argparse
import dataclasses
import functools
import math
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Optional

import torch

from ..core.command import run_command
from ..core.errors import UserError, unknown
from ..core.files import output_folder
from ..core.options import shown
from ..core.signals import interrupt
from ..launch.folder_lock import claim
from .autoencoder_stage import AutoencoderStage
from .clip_stage import ClipStage, TextStage
from .judge_stage import SEED_OFFSET, JudgeStage, judge_shards
from .loop import Options, Stage, Training
from .points_stage import PointsStage
from .unet_stage import UNetStage
from .views import Shards
from .warm_start import start_from

IN_ORDER = TextStage, ClipStage, AutoencoderStage, UNetStage, PointsStage, JudgeStage
STAGES: dict[str, type[Stage]] = {stage.name: stage for stage in IN_ORDER}
"""In the order of training: later ones need earlier ones."""


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.train", description="Train the toybox's models."
    )
    add = parser.add_argument
    add("folder", type=Path, help="pictures, checkpoints and curves; continued if it exists")
    add("--stages", nargs="+", default=list(STAGES), help=f"of {', '.join(STAGES)}; default: all")
    add("--images", type=int, help="a stage's end; default: its own number of pictures")
    add("--minutes", type=float, default=math.inf, help="a stage's end, if that comes earlier")
    add("--from-weights", type=Path, help="folder of toybox.export to start from")
    add("--seed", type=int, default=0)
    add("--device", default="cpu", help="cpu or cuda")
    bfloat16 = "bfloat16: autocast, on a GPU or a CPU that multiplies it"
    add("--precision", choices=["float32", "bfloat16"], default="float32", help=bfloat16)
    add("--batch", type=int, help="pictures of one step; default: the stage's own")
    add("--pool", type=int, default=40, help="shards of 1024 pictures, visited cyclically")
    workers = "processes that render all shards first and make the batches afterwards"
    add("--workers", type=int, default=0, help=workers)
    return parser.parse_args(argv)


def options_of(args: argparse.Namespace) -> Options:
    """Return the checked options.

    Raises:
        UserError: an unknown stage, a number out of range, or no such device.
    """
    for name in args.stages:
        if name not in STAGES:
            raise unknown("stage", name, STAGES)
    for name, least in {"images": 1, "batch": 1, "pool": 1, "workers": 0}.items():
        value = getattr(args, name)
        if value is not None and value < least:
            raise UserError(f"--{name} {shown(value)}: expected {least} or more")
    if not 0 <= args.seed < SEED_OFFSET:
        raise UserError(
            f"--seed {shown(args.seed)}: expected 0 to {SEED_OFFSET - 1}; larger seeds are of the "
            "objects that the judge learns from"
        )
    if not args.minutes > 0:
        raise UserError(f"--minutes {args.minutes}: expected more than 0")
    if args.device.startswith("cuda") and not torch.cuda.is_available():
        raise UserError(f"--device {args.device}: PyTorch sees no GPU here; give cpu")
    devices = ["cpu", "cuda", *(f"cuda:{i}" for i in range(torch.cuda.device_count()))]
    if args.device not in devices:
        raise unknown("device", args.device, devices)
    given = {field.name for field in dataclasses.fields(Options)} & set(vars(args))
    return Options(**{name: getattr(args, name) for name in given})


def render_shards(sorts: Sequence[Shards], count: int, workers: int) -> None:
    """Render the missing ones of the first ``count`` shards of each sort, in parallel."""
    jobs = [(shards, index) for shards in sorts for index in range(count)]
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(Shards.ensure, *zip(*jobs, strict=True)), 1):
            print(f"rendered {done}/{len(jobs)} shards", flush=True)


def train(
    options: Options, stages: Sequence[str], images: Optional[int] = None, seconds=math.inf
) -> None:
    """Train the stages in order, each until ``images`` were seen or ``seconds`` have passed.

    Raises:
        UserError: another process trains one of them in this folder.
        Terminated, KeyboardInterrupt: a signal stopped one, after it wrote its checkpoint.
    """
    for name in (name for name in STAGES if name in stages):
        # another process's checkpoints would replace these
        busy = f"another process trains the stage {name!r}"
        claimed = claim(options.folder / "locks" / name, busy, ", or give another folder")
        try:
            training = Training(STAGES[name](options))
            progress = training.run(images, seconds)
        finally:
            claimed.release()
        hours = progress.seconds / 3600
        print(f"{name}: {progress.images} images in {hours:.2f} hours", flush=True)
        if training.signum:
            interrupt(training.signum)


def run(args: argparse.Namespace) -> None:
    """Check the options, and train.

    Raises:
        UserError: an option is invalid, or a file can't be written or doesn't fit.
        Terminated, KeyboardInterrupt: a signal stopped the training; a checkpoint is written.
    """
    options = options_of(args)
    output_folder(options.folder, "FOLDER")
    if args.workers:
        of_judge = judge_shards(options) if JudgeStage.name in args.stages else ()
        workers = min(args.workers, os.cpu_count() or 1)
        render_shards([options.shards, *of_judge], options.pool, workers)
    if args.from_weights:
        start_from(args.from_weights, options, STAGES)
    train(options, args.stages, args.images, 60 * args.minutes)


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
