"""Draw objects of the world: ``python -m threestudio_gaussiandreamer.toybox.world_sheet FILE``."""

import argparse
import functools
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import UInt8

from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import require_writable, through_link
from ..core.images import write
from ..core.options import shown
from ..core.streams import numpy_generator
from .sheet import contact_sheet
from .text_batches import view_prompts
from .views import Shards, with_backgrounds

MAX_COUNT = 10_000


def world_sheet(count: int = 100, seed: int = 0) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the first ``count`` objects of a seed, a view of each, with a prompt below it."""
    shard = Shards(Path(), seed, objects=count, views=1).make(0)
    rng = numpy_generator(seed, "toybox-sheet")
    prompts = view_prompts(shard, np.arange(count), rng)
    return contact_sheet(with_backgrounds(shard.rgba, rng, random_share=0), prompts)


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.world_sheet", description="Draw objects of the toybox."
    )
    parser.add_argument("file", type=Path, help="PNG")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Check the options, draw, and write the file."""
    if not 1 <= args.count <= MAX_COUNT:
        raise UserError(f"--count {shown(args.count)}: expected 1 to {MAX_COUNT} objects")
    args.file = through_link(args.file)
    if args.file.suffix.lower() != ".png":
        raise UserError(f"FILE: expected the name of a PNG, got {shown(str(args.file))}")
    require_writable(args.file, "FILE")
    write(args.file, world_sheet(args.count, args.seed))


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
