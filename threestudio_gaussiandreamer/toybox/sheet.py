"""Contact sheets of pictures with their texts: of the world, of training samples, of results."""

import textwrap
from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Float, UInt8

LINE = 11
"""Pixels from line to line of the texts."""


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
