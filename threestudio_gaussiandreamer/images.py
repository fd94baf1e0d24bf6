"""8 bit RGB images from arrays, and image files: colour maps, grids, animations."""

import io
import os
import zlib
from pathlib import Path
from typing import Any, Optional

import numpy as np

from .core.errors import UserError
from .core.files import existing_file, write_file

_COLOR_MAPS = {
    "jet": "000080 0000ff 0080ff 00ffff 80ff80 ffff00 ff8000 ff0000 800000",
    "magma": "000004 1c1044 4f127b 812581 b5367a e55064 fb8761 fec287 fcfdbf",
}
"""Knots at equal distances over [0, 1]."""
_PNG_OPTIONS = {"compress_level": 1, "compress_type": zlib.Z_RLE}
"""As OpenCV's: renders take a third of the time that Pillow's own take, and no more bytes."""


def rgb(
    image: np.ndarray, *, data_format: str = "HWC", data_range: tuple[float, float] = (0, 1)
) -> np.ndarray:
    """Convert (H,W,C), or (C,H,W) with ``data_format="CHW"``, to uint8 (H, W*ceil(C/3), 3):
    channels lie side by side, three by three; missing ones are black.
    """
    image = np.moveaxis(np.asarray(image), {"HWC": -1, "CHW": 0}[data_format], -1)
    image = image if image.dtype == np.uint8 else _to_bytes(_normalize(image, data_range))
    missing = -image.shape[-1] % 3
    image = np.pad(image, ((0, 0), (0, 0), (0, missing)))
    return np.concatenate(np.split(image, image.shape[-1] // 3, axis=-1), axis=1)


def grayscale(
    image: np.ndarray,
    *,
    data_range: Optional[tuple[float, float]] = None,
    cmap: Optional[str] = "jet",
) -> np.ndarray:
    """Convert (H,W) to uint8 (H,W,3) by a colour map, "jet" or "magma", or to grey without one;
    ``data_range`` are the values of its ends, by default the smallest and largest.
    """
    image = np.nan_to_num(image)
    values = _normalize(image, data_range or (image.min(), image.max()))
    if cmap is None:
        return np.repeat(_to_bytes(values)[..., None], 3, axis=-1)
    knots = np.array([list(bytes.fromhex(knot)) for knot in _COLOR_MAPS[cmap].split()], np.float64)
    positions = np.linspace(0, 1, len(knots))
    channels = [np.interp(values, positions, knots[:, c]) for c in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def grid(cells: list) -> np.ndarray:
    """Compose a row of ``{"type", "img", "kwargs"}``, or a list of rows, into one image."""
    from PIL import Image

    if isinstance(cells[0], list):
        rows = [grid(row) for row in cells]
        width = max(row.shape[1] for row in rows)
        return np.concatenate([np.pad(r, ((0, 0), (0, width - r.shape[1]), (0, 0))) for r in rows])
    makers = {"rgb": rgb, "grayscale": grayscale}
    images = [makers[cell["type"]](cell["img"], **cell.get("kwargs", {})) for cell in cells]
    height, width = np.max([image.shape[:2] for image in images], axis=0).tolist()
    size, method = (width, height), Image.Resampling.BILINEAR
    return np.concatenate([Image.fromarray(x).resize(size, method) for x in images], axis=1)


def read(path: str | os.PathLike) -> np.ndarray:
    """Read an image as uint8 (H,W,3); raise UserError if it is missing or damaged."""
    from PIL import Image

    path = existing_file(path, "image")
    try:
        return np.asarray(Image.open(path).convert("RGB"))
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise UserError(f"image {str(path)!r} can't be read: {error}") from error


def write(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write an image in the format of the extension; raise UserError if it can't be written."""
    from PIL import Image

    _save(path, Image.fromarray(image), **_PNG_OPTIONS)


def write_animation(
    path: str | os.PathLike, frames: list[Path], size: Optional[int], seconds: float
) -> None:
    """Write pictures as an animated WebP or GIF that repeats after ``seconds``, or raise UserError;
    larger ones are shrunk to ``size`` pixels.
    """
    from PIL import Image

    first, *others = pictures = [Image.open(frame).convert("RGB") for frame in frames]
    for image in pictures if size else ():
        image.thumbnail((size, size), Image.Resampling.LANCZOS)
    options = {"duration": round(1000 * seconds / len(pictures)), "quality": 80, "method": 2}
    _save(path, first, save_all=True, append_images=others, loop=0, **options)


def _save(path: str | os.PathLike, image: Any, **options: Any) -> None:
    from PIL import Image

    content = io.BytesIO()
    image.save(content, Image.registered_extensions()[Path(path).suffix.lower()], **options)
    write_file(path, content.getvalue(), durable=False)


def _normalize(image: np.ndarray, data_range: tuple[float, float]) -> np.ndarray:
    low, high = data_range
    # a constant image is black, not 0/0
    return (np.clip(np.nan_to_num(image), low, high) - low) / ((high - low) or 1)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return (values * 255).round().astype(np.uint8)
