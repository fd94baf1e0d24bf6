"""8 bit RGB images from arrays, and image and video files: colour maps, grids, captions."""

import io
import os
import struct
import zlib
from pathlib import Path
from typing import Optional

import numpy as np

from .errors import UserError
from .files import atomic_file, existing_file

_COLOR_MAPS = {
    "jet": "000080 0000ff 0080ff 00ffff 80ff80 ffff00 ff8000 ff0000 800000",
    "magma": "000004 1c1044 4f127b 812581 b5367a e55064 fb8761 fec287 fcfdbf",
}
"""Knots at equal distances over [0, 1]."""
_PNG_OPTIONS = {"compress_level": 1, "compress_type": zlib.Z_RLE}
"""As OpenCV's: renders take a third of the time that Pillow's own take, and no more bytes."""
_MP4_OPTIONS = {
    "format": "FFMPEG",  # else imageio without imageio-ffmpeg takes another plugin, and fails in it
    "codec": "libx264",
    "pixelformat": "yuv420p",
    "macro_block_size": 1,
    "output_params": [
        # put the index first, so that a browser can start to play before it has the whole file
        *("-movflags", "+faststart"),
        # ffmpeg takes BT.601's matrix and says nothing; players assume BT.709's above 720 lines
        *("-vf", "scale=out_color_matrix=bt709:out_range=tv"),
        *("-colorspace", "bt709", "-color_primaries", "bt709"),
        *("-color_trc", "bt709", "-color_range", "tv"),
    ],
}


def rgb(
    image: np.ndarray, *, data_format: str = "HWC", data_range: tuple[float, float] = (0, 1)
) -> np.ndarray:
    """Convert (H,W,C) or (C,H,W) to uint8 (H, W*ceil(C/3), 3).

    Channels lie side by side, three by three; missing ones are black.

    Raises:
        ValueError: ``data_format`` is neither "HWC" nor "CHW".
    """
    if data_format not in ("HWC", "CHW"):
        raise ValueError(f"data_format is {data_format!r}; expected 'HWC' or 'CHW'")
    if data_format == "CHW":
        image = image.transpose(1, 2, 0)
    image = image if image.dtype == np.uint8 else _to_bytes(_normalize(image, data_range))
    missing = -image.shape[-1] % 3
    image = np.concatenate([image, np.zeros((*image.shape[:-1], missing), np.uint8)], axis=-1)
    return np.concatenate(np.split(image, image.shape[-1] // 3, axis=-1), axis=1)


def grayscale(
    image: np.ndarray,
    *,
    data_range: Optional[tuple[float, float]] = None,
    cmap: Optional[str] = "jet",
) -> np.ndarray:
    """Convert (H,W) to uint8 (H,W,3) by a colour map, or to grey without one.

    Args:
        data_range: values of the first and the last colour; by default the smallest and largest.

    Raises:
        ValueError: an unknown colour map.
    """
    image = np.nan_to_num(image)
    values = _normalize(image, data_range or (image.min(), image.max()))
    if cmap is None:
        return np.repeat(_to_bytes(values)[..., None], 3, axis=-1)
    if cmap not in _COLOR_MAPS:
        raise ValueError(
            f"unknown colour map {cmap!r}; expected None or one of {', '.join(_COLOR_MAPS)}"
        )
    knots = np.array([list(bytes.fromhex(knot)) for knot in _COLOR_MAPS[cmap].split()], np.float64)
    positions = np.linspace(0, 1, len(knots))
    channels = [np.interp(values, positions, knots[:, c]) for c in range(3)]
    return np.stack(channels, axis=-1).round().astype(np.uint8)


def grid(cells: list) -> np.ndarray:
    """Compose a row of ``{"type", "img", "kwargs"}``, or a list of rows, into one image; all cells
    of a row get the size of the largest.
    """
    if isinstance(cells[0], list):
        rows = [grid(row) for row in cells]
        width = max(row.shape[1] for row in rows)
        return np.concatenate([_padded(row, 0, width - row.shape[1]) for row in rows], axis=0)
    makers = {"rgb": rgb, "grayscale": grayscale}
    images = [makers[cell["type"]](cell["img"], **cell.get("kwargs", {})) for cell in cells]
    height, width = np.max([image.shape[:2] for image in images], axis=0).tolist()
    return np.concatenate([_resize(image, height, width) for image in images], axis=1)


def with_texts(image: np.ndarray, texts: list) -> np.ndarray:
    """Draw one line of text at the top of each of ``len(texts)`` equal bands of the image."""
    from PIL import Image, ImageDraw

    canvas = Image.fromarray(image)
    draw, band = ImageDraw.Draw(canvas), image.shape[0] // max(len(texts), 1)
    black_on_white = {"fill": (0, 0, 0), "stroke_width": 1, "stroke_fill": (255, 255, 255)}
    for row, text in enumerate(texts):
        draw.text((2, row * band), str(text), **black_on_white)
    return np.asarray(canvas)


def read(path: str | os.PathLike) -> np.ndarray:
    """Read an image as uint8 (H,W,3).

    Raises:
        UserError: there is no such file, or it is damaged.
    """
    from PIL import Image

    path = existing_file(path, "image")
    try:
        return np.asarray(Image.open(path).convert("RGB"))
    except Exception as error:  # Pillow raises many kinds for damaged files
        raise UserError(f"image {str(path)!r} can't be read: {error}") from error


def write(path: str | os.PathLike, image: np.ndarray) -> None:
    """Write an image, uint8 or uint16, in the format of the extension.

    Raises:
        UserError: the disk is full or the folder can't be written.
    """
    import imageio.v3 as iio

    suffix = Path(path).suffix
    options = _PNG_OPTIONS if suffix.lower() == ".png" else {}
    content = iio.imwrite("<bytes>", image, extension=suffix, **options)
    with atomic_file(path, durable=False) as file:
        file.write(content)


def write_video(path: str, frames: list[Path], *, fps: int) -> None:
    """Write the images as an mp4 (H.264, yuv420p, index first; padded to an even size) or gif.

    Raises:
        UserError: the disk is full, there is no ffmpeg, or the images differ in size.
    """
    import imageio.v2 as imageio

    mp4, part = path.endswith(".mp4"), Path(path).with_name(f".part-{Path(path).name}")
    options = {"fps": fps, **_MP4_OPTIONS} if mp4 else {"duration": 1000 / fps, "loop": 0}
    try:
        with imageio.get_writer(part, mode="I", **options) as writer:
            for frame in frames:
                image = imageio.imread(frame)[..., :3]
                odd = image.shape[0] % 2, image.shape[1] % 2
                writer.append_data(_padded(image, *odd, "edge") if mp4 else image)
        if mp4:
            _require_whole_mp4(part)
        os.replace(part, path)
    except ImportError as error:
        raise UserError(f"the video {path} needs ffmpeg: pip install imageio-ffmpeg") from error
    except (OSError, RuntimeError, ValueError) as error:  # the last: pictures of several sizes
        raise UserError(f"the video {path} could not be written: {error}") from error
    finally:
        part.unlink(missing_ok=True)


def write_animation(path: Path, frames: list[Path], size: int, seconds: float) -> None:
    """Write pictures as an animated WebP that repeats.

    Args:
        size: the largest width and height, pixels; larger pictures are shrunk.
        seconds: of one round.

    Raises:
        UserError: the disk is full or the folder can't be written.
    """
    from PIL import Image

    pictures = [Image.open(frame).convert("RGB") for frame in frames]
    for image in pictures:
        image.thumbnail((size, size), Image.Resampling.LANCZOS)
    options = {"duration": round(1000 * seconds / len(pictures)), "loop": 0}
    content = io.BytesIO()
    pictures[0].save(
        content, "webp", save_all=True, append_images=pictures[1:], quality=80, method=2, **options
    )
    with atomic_file(path, durable=False) as file:
        file.write(content.getvalue())


def _require_whole_mp4(path: Path) -> None:
    """Raise OSError unless the boxes of the MP4, of less than 4 GB, fill the file and its index
    (moov) is among them: imageio doesn't report when ffmpeg ends early, as on a full disk.
    """
    names, place, content = [], 0, path.read_bytes()
    while place + 8 <= len(content):
        length, name = struct.unpack_from(">I4s", content, place)
        names.append(name)
        place += max(length, 8)
    if place != len(content) or b"moov" not in names:
        raise OSError("ffmpeg ended before the file was complete; is the disk full?")


def _normalize(image: np.ndarray, data_range: tuple[float, float]) -> np.ndarray:
    low, high = data_range
    # a constant image is black, not 0/0
    return (np.clip(np.nan_to_num(image), low, high) - low) / ((high - low) or 1)


def _to_bytes(values: np.ndarray) -> np.ndarray:
    return (values * 255).round().astype(np.uint8)


def _padded(image: np.ndarray, rows: int, columns: int, mode: str = "constant") -> np.ndarray:
    return np.pad(image, ((0, rows), (0, columns), (0, 0)), mode=mode)


def _resize(image: np.ndarray, height: int, width: int) -> np.ndarray:
    if image.shape[:2] == (height, width):
        return image
    from PIL import Image

    return np.asarray(Image.fromarray(image).resize((width, height), Image.Resampling.BILINEAR))
