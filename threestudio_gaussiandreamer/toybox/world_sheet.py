"""Draw objects of the world: ``python -m threestudio_gaussiandreamer.toybox.world_sheet FILE``."""

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import UInt8

from ..core.images import write
from ..core.streams import numpy_generator
from .sheet import contact_sheet
from .text_batches import view_prompts
from .views import Shards, with_backgrounds


def world_sheet(count: int = 100, seed: int = 0) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the first ``count`` objects of a seed, a view of each, with a prompt below it."""
    shard = Shards(Path(), seed, objects=count, views=1).make(0)
    rng = numpy_generator(seed, "toybox-sheet")
    prompts = view_prompts(shard, np.arange(count), rng)
    return contact_sheet(with_backgrounds(shard.rgba, rng, random_share=0), prompts)


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line; returns the exit code."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.world_sheet", description="Draw objects of the toybox."
    )
    parser.add_argument("file", type=Path, help="PNG")
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=0)
    args = parser.parse_args(argv)
    write(args.file, world_sheet(args.count, args.seed))
    return 0


if __name__ == "__main__":
    sys.exit(main())
