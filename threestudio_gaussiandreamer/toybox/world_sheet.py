"""Draw objects of the world: ``python -m threestudio_gaussiandreamer.toybox.world_sheet FILE``."""

import argparse
import functools
import sys
import textwrap
from collections.abc import Sequence
from pathlib import Path
from typing import Optional

import numpy as np
import torch
from jaxtyping import Float, UInt8

from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import require_writable, through_link
from ..core.images import write
from ..core.options import shown
from ..core.streams import numpy_generator
from .tokens import view_prompts
from .views import Shards, with_backgrounds

LINE = 11
"""Pixels from line to line of the texts."""


def world_sheet(count: int = 100) -> UInt8[np.ndarray, "h w 3"]:
    """Draw the first ``count`` objects, a view of each, with a prompt below it."""
    shard = Shards(Path(), 0, objects=count, views=1).make(0)
    rng = numpy_generator(0, "toybox-sheet")
    prompts = view_prompts(shard, np.arange(count), rng)
    return contact_sheet(with_backgrounds(shard.rgba, rng, random_share=0), prompts)


def contact_sheet(
    images: Float[torch.Tensor, "N 3 H W"], texts: Sequence[str] = (), columns: int = 10
) -> UInt8[np.ndarray, "h w 3"]:
    """Arrange pictures (values in [0, 1]) in rows, each with its whole text below it."""
    from PIL import Image, ImageDraw

    height, width = images.shape[-2:]
    wrapped = [textwrap.wrap(text, width // 6) for text in texts] or [[]] * len(images)
    most = max(map(len, wrapped), default=0)
    cell = height + (most * LINE + 3 if most else 0)
    rows = -(-len(images) // columns)
    sheet = Image.new("RGB", (columns * width, rows * cell), "white")
    draw = ImageDraw.Draw(sheet)
    pixels = (images.clamp(0, 1) * 255).round().byte().movedim(1, -1).cpu().numpy()
    for index, image in enumerate(pixels):
        x, y = index % columns * width, index // columns * cell
        sheet.paste(Image.fromarray(image), (x, y))
        for line, words in enumerate(wrapped[index]):
            draw.text((x + 2, y + height + line * LINE), words, fill="black")
    return np.asarray(sheet)


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.world_sheet", description="Draw objects of the toybox."
    )
    parser.add_argument("file", type=Path, help="PNG")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Draw, and write the file."""
    args.file = through_link(args.file)
    if args.file.suffix.lower() != ".png":
        raise UserError(f"FILE: expected the name of a PNG, got {shown(str(args.file))}")
    require_writable(args.file, "FILE")
    write(args.file, world_sheet())


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
