"""Files that a mesh file references, buffers of glTF, materials of OBJ, textures of both, and the
memory that loading may allocate, by the sizes in the headers: a small file can expand to a large
size. There is one budget for a mesh file and the files that it references."""

import codecs
import contextlib
import io
import logging
import os
import stat
import unicodedata
import urllib.parse
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Optional

import numpy as np
from jaxtyping import UInt8

from ..formats.reading import BYTES_PER_FILE_BYTE, Unreadable, require

log = logging.getLogger(__name__)

FIXED_BYTES = 1 << 30
"""Budget of every file, besides its size: a texture of 8192 x 8192, or three million triangles."""
BYTES_PER_TEXEL, BYTES_PER_VERTEX, BYTES_PER_FACE = 14, 200, 150
"""Peak memory while a part is decoded, merged, cleaned and transformed."""
ENCODINGS = ("latin-1", "cp1252", "cp1250", "cp1251", "gb18030", "shift_jis", "cp949", "big5")
"""Of names in files that aren't UTF-8."""
FORMATS = ("PNG", "JPEG", "WEBP", "BMP", "GIF", "TGA", "TIFF")
consulted: dict[str, Optional[tuple[int, int]]] = {}
"""The ``stamp`` of every file that a mesh has named; the prior's cache reads and clears it."""


class Budget:
    """Bytes that a mesh may take: more with every file that is read, less with what is decoded."""

    def __init__(self, path: Path) -> None:
        self.left = self.total = FIXED_BYTES
        self.add_file(path.stat().st_size)

    def add_file(self, size: int) -> None:
        """Increase the budget for a file of ``size`` bytes."""
        self.left += BYTES_PER_FILE_BYTE * size
        self.total += BYTES_PER_FILE_BYTE * size

    def spend(self, size: int, what: str) -> None:
        """Deduct ``size`` bytes; raise Unreadable if ``what`` exceeds the budget."""
        self.left -= size
        require(
            self.left >= 0,
            f"{what} is too large: textures, vertices and faces of a file of this size may take "
            f"{self.total >> 20} MiB of memory together",
        )

    def spend_geometry(self, vertices: int, faces: int) -> None:
        """Deduct the bytes of one part of the scene."""
        size = BYTES_PER_VERTEX * vertices + BYTES_PER_FACE * faces
        self.spend(size, f"a part with {vertices} vertices and {faces} faces")


def stamp(path: str | Path) -> Optional[tuple[int, int]]:
    """Return size and time of change of a file; None if there is none."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_size, status.st_mtime_ns


def utf8(text: bytes) -> bytes:
    """Return a text in UTF-8, without a byte order mark; one in an encoding without a mark becomes
    one character per byte, from which ``SideFiles`` finds the files that it names.
    """
    if text[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return text.decode("utf-16", "replace").encode()
    try:
        return text.decode("utf-8-sig").encode()
    except UnicodeDecodeError:
        return text.decode("latin-1").encode()


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", urllib.parse.unquote(name)).casefold()


def _spellings(name: str) -> set[str]:
    """Return how a mesh file may spell the name of a file, apart from case and accents' form."""
    name = unicodedata.normalize("NFC", name)
    raw = [name.encode(encoding, "backslashreplace") for encoding in ENCODINGS]
    texts = (x.decode(y, "backslashreplace") for x in raw for y in ("latin-1", "utf-8"))
    return {_plain(x) for x in (name, *texts)}


class SideFiles:
    """Reads files whose names are relative to the mesh file."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.path, self.budget = path, budget

    def read(self, name: str, *others: str) -> Optional[bytes]:
        """Return the content of the first of these files that exists; None, with a warning about
        ``name``, if there is none.

        Names are relative to the mesh's folder and may have the separators of Windows, quotes and
        escaped spaces. If there is no such file, one with the same base name next to the mesh is
        read, else one whose name differs in case, accents' form, percent-encoding or encoding.
        Unreadable if it is no regular file (a FIFO would block), or can't be read.
        """
        for place in self._places(name, *others):
            try:
                return self._content(place)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except (OSError, ValueError) as error:  # ValueError: a NUL in the name
                said = f"the file {name[:200]!r} that it names isn't readable: {error}"
                raise Unreadable(said) from error
        log.warning("%s names the file %r, which does not exist", self.path, name[:200])
        return None

    def _places(self, *names: str) -> Iterator[Path]:
        plain = [x.strip().strip("\"'").replace("\\ ", " ").replace("\\", "/") for x in names]
        relative = [x.lstrip("/") for x in plain]
        found = [self.path.parent / x for x in (*relative, *(y.split("/")[-1] for y in relative))]
        yield from found
        for place in found:
            with contextlib.suppress(OSError, ValueError):
                beside = sorted(place.parent.iterdir())
                yield from (x for x in beside if _plain(place.name) in _spellings(x.name))

    def _content(self, path: Path) -> bytes:
        consulted[str(path)] = stamp(path)
        # without O_NONBLOCK, opening a FIFO blocks until another process opens it for writing
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise OSError(f"{str(path)!r} is not a regular file")
            self.budget.add_file(status.st_size)
            return file.read()


def decode_texture(data: bytes, name: str, budget: Budget) -> UInt8[np.ndarray, "H W 3"]:
    """Decode an image file in one of ``FORMATS``: alpha is ignored, 16-bit values are rounded to 8
    bits. Unreadable if it is damaged or exceeds the budget.
    """
    return decode_image(open_texture(data, name), name, budget)


@contextlib.contextmanager
def _pillow_errors(name: str) -> Iterator[None]:
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)  # see budget.spend
            yield
    except Exception as error:  # Pillow's readers raise errors of many types
        formats = f"it is damaged, or in none of the formats {', '.join(FORMATS)}"
        raise Unreadable(f"the texture {name} can't be read: {formats}") from error


def open_texture(data: bytes, name: str) -> Any:
    """Open an image file with Pillow, without loading its texels."""
    from PIL import Image

    with _pillow_errors(name):
        return Image.open(io.BytesIO(data), formats=FORMATS)


def decode_image(image: Any, name: str, budget: Budget) -> UInt8[np.ndarray, "H W 3"]:
    """Decode an image that Pillow has opened but not yet loaded."""
    size = f"the texture {name} of {image.width} x {image.height} texels"
    budget.spend(BYTES_PER_TEXEL * image.width * image.height, size)
    with _pillow_errors(name):
        if not image.mode.startswith("I"):
            return np.array(image.convert("RGB"))
        values = np.asarray(image).astype(np.int64).clip(0, 65535)  # Pillow would clip at 255
        texels = ((values * 255 + 32767) // 65535).astype(np.uint8)
        return np.repeat(texels[..., None], 3, axis=2)
