"""Decode textures to arrays of 8-bit RGB."""

import io
import struct
import warnings
from typing import Any

import numpy as np
from jaxtyping import UInt8

from .budget import BYTES_PER_TEXEL, Budget, fail

FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA", "TIFF")
UNREADABLE = (OSError, ValueError, SyntaxError, EOFError, OverflowError, struct.error)
"""Exceptions that Pillow raises for damaged files."""
ROWS_AT_ONCE = 256
"""Rows converted at a time, which limits the peak memory to two copies of the image, not four."""


def decode_texture(data: bytes, name: str, budget: Budget) -> UInt8[np.ndarray, "H W 3"]:
    """Decode an image file; alpha is ignored, 16-bit values are rounded to 8 bits.

    Args:
        data: content of a file in one of ``FORMATS``.
        name: names the texture in messages.

    Raises:
        UserError: it can't be decoded, or exceeds the budget.
    """
    return decode_image(open_texture(data, name, budget), name, budget)


def open_texture(data: bytes, name: str, budget: Budget) -> Any:
    """Open an image file with Pillow, without loading its texels.

    Raises:
        UserError: it isn't an image in one of ``FORMATS``.
    """
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # see budget.spend
            return Image.open(io.BytesIO(data), formats=FORMATS)
    except UnidentifiedImageError:  # Pillow's message names a Python object
        fail(budget.path, f"the texture {name} is in none of the formats {', '.join(FORMATS)}")
    except (*UNREADABLE, Image.DecompressionBombError) as error:
        fail(budget.path, f"the texture {name} can't be read: {error}")


def decode_image(image: Any, name: str, budget: Budget) -> UInt8[np.ndarray, "H W 3"]:
    """Decode an image that Pillow has opened but not yet loaded.

    Raises:
        UserError: its format isn't one of ``FORMATS``, it is damaged, or it exceeds the budget.
    """
    if image.format not in FORMATS:
        fail(budget.path, f"the texture {name} is {image.format}, not one of {', '.join(FORMATS)}")
    size = f"the texture {name} of {image.width} x {image.height} texels"
    budget.spend(BYTES_PER_TEXEL * image.width * image.height, size)
    try:
        image.load()
        return _rgb_rows(image)
    except UNREADABLE as error:
        fail(budget.path, f"the texture {name} is damaged: {error}")


def _rgb_rows(image: Any) -> UInt8[np.ndarray, "H W 3"]:
    texels = np.empty((image.height, image.width, 3), np.uint8)
    for top in range(0, image.height, ROWS_AT_ONCE):
        bottom = min(top + ROWS_AT_ONCE, image.height)
        texels[top:bottom] = _rgb(image.crop((0, top, image.width, bottom)))
    return texels


def _rgb(image: Any) -> np.ndarray:
    """Return (H, W, 3), or (H, W, 1) for one channel of 16 bits, which Pillow would clip at 255."""
    if image.mode.startswith("I"):
        values = np.asarray(image).astype(np.int64).clip(0, 65535)
        return ((values * 255 + 32767) // 65535)[..., None]
    return np.asarray(image.convert("RGB"))
