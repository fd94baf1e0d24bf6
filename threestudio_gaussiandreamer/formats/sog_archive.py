"""The archive of an SOG file, or its folder: JSON and images, checked before they are unpacked.

Members are read into memory by the names in ``meta.json``; nothing is written to the disk, and the
images of a folder lie beside its ``meta.json``, so names can't lead anywhere."""

import io
import json
import math
import os
import struct
import zipfile
import zlib
from types import TracebackType
from typing import Any, NoReturn, Optional

import numpy as np
from jaxtyping import Float, Integer

from ..core.errors import UserError
from ..core.file_memory import require_file_memory
from ..core.files import existing_file
from ..gaussians.sh import COEFFICIENTS

VERSIONS = 1, 2
CODEBOOK = 256
PALETTE_COLUMNS = 64
FIRST_TAG = 252
"""Alpha of a quaternion whose largest component is number 0."""
MAX_META_BYTES = 1 << 19
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 200, 24
"""Bytes of memory that reading takes per Gaussian, and per harmonic of it, with a safety margin."""
BYTES_PER_PIXEL = 24
"""Memory for a pixel of an image while it is decoded."""
FORMATS = {b"RIFF": "WEBP", b"\x89PNG": "PNG"}
"""Of images, by their first bytes."""
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
DAMAGED = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    NotImplementedError,
    RuntimeError,
    EOFError,
)


class SogArchive:
    """An open SOG file, or the ``meta.json`` of an unpacked one.

    Raises:
        UserError: there is no such file, it is no SOG of version 1 or 2, it is damaged, or it
            announces more than the memory budget of its size.
    """

    def __init__(self, path: str | os.PathLike) -> None:
        self.path = existing_file(path, "SOG file")
        self._zip: Optional[zipfile.ZipFile] = None
        unpacked = self.path.suffix.lower() == ".json"
        beside = self.path.parent.iterdir() if unpacked else ()
        files = [self.path, *(file for file in beside if file.suffix in (".webp", ".png"))]
        self.size = sum(file.stat().st_size for file in files)
        try:
            self._zip = None if unpacked else zipfile.ZipFile(self.path)
        except (*DAMAGED, OSError, ValueError) as error:
            self.fail(f"it isn't a zip archive, or damaged ({error})")
        names = self._zip.namelist() if self._zip else []
        found = [name for name in names if name.split("/")[-1] == "meta.json"]
        # a folder that was packed by hand is in the names of its files
        self._folder = min(found, key=len, default="meta.json").removesuffix("meta.json")
        self.meta = self._read_meta()
        self.version: int = self.meta.get("version", 1)
        shape = self._section("means").get("shape") if self.version == 1 else None
        counted = {"count": shape[0]} if isinstance(shape, list) and shape else self.meta
        self.count: int = self._number(counted, "count")
        harmonics = COEFFICIENTS[self._bands()]
        needed = self.count * (DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * harmonics)
        self._require_memory(needed, f"{self.count} Gaussians")

    def __enter__(self) -> "SogArchive":
        return self

    def __exit__(
        self,
        kind: Optional[type[BaseException]],
        error: Optional[BaseException],
        trace: Optional[TracebackType],
    ) -> None:
        if self._zip is not None:
            self._zip.close()

    def fail(self, problem: str) -> NoReturn:
        """Raise UserError about this file."""
        raise UserError(f"SOG file {str(self.path)!r}: {problem}")

    # ---- the JSON --------------------------------------------------------------------------------

    def notes(self) -> list[str]:
        """Return the lines that our writer adds; empty in files of other programs."""
        notes = self.meta.get("notes", [])
        return [note for note in notes if isinstance(note, str)] if isinstance(notes, list) else []

    def bounds(self) -> tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]]:
        """Return the smallest and the largest logarithm of the positions, for each axis."""
        means = self._section("means")
        return self._floats(means, "mins", 3), self._floats(means, "maxs", 3)

    def values(
        self, section: str, pixels: Integer[np.ndarray, "*N C"], channels: int = 3
    ) -> Float[np.ndarray, "*N C"]:
        """Return what the bytes of an image stand for: entries of a codebook, in version 1 steps
        between ``mins`` and ``maxs`` of each of the section's ``channels`` (1: of all).
        """
        about = self._section(section)
        if self.version == 1:
            low, high = (self._floats(about, key, channels) for key in ("mins", "maxs"))
            book = np.linspace(low, high, CODEBOOK)
        else:
            book = self._floats(about, "codebook", CODEBOOK)[:, None]
        book = book.astype(np.float32)
        if book.shape[1] == 1:  # indices by a second axis take memory
            return book[:, 0][pixels]
        return book[pixels, np.arange(pixels.shape[-1]) % book.shape[1]]

    def _read_meta(self) -> dict[str, Any]:
        try:
            name = "meta.json" if self._zip else self.path.name
            meta = json.loads(self._member(name, MAX_META_BYTES).decode("utf-8"))
        except (ValueError, RecursionError) as error:
            if isinstance(error, UserError):
                raise
            self.fail(f"its meta.json isn't valid JSON ({str(error)[:100]})")
        version = meta.get("version", 1) if isinstance(meta, dict) else None
        if version not in VERSIONS:
            self.fail(f"it is of version {str(version)[:20]}; version 1 or 2 was expected")
        return meta

    def _section(self, name: str) -> dict[str, Any]:
        section = self.meta.get(name)
        if not isinstance(section, dict):
            self.fail(f"its meta.json has no section {name!r}")
        return section

    def _number(self, section: dict[str, Any], key: str) -> int:
        value = section.get(key)
        if type(value) is not int or value < 0:
            self.fail(f"{key} should be 0 or more, not {str(value)[:40]}")
        return value

    def _floats(self, section: dict[str, Any], key: str, count: int) -> Float[np.ndarray, " C"]:
        values = section.get(key)
        values = [values] if count == 1 and not isinstance(values, list) else values
        usual = isinstance(values, list) and len(values) == count
        if not usual or not all(type(value) in (int, float) for value in values):
            self.fail(f"{key} should be {count} numbers, not {str(values)[:80]}")
        numbers = np.array([min(max(value, -1e38), 1e38) for value in values], np.float64)
        if not np.isfinite(numbers).all():
            self.fail(f"{key} holds NaN")
        return numbers

    def _bands(self) -> int:
        """Return the degree of the harmonics."""
        if self.meta.get("shN") is None:
            return 0
        if self.version == 1:
            width = self._image_size(*self._image("shN", 0))[0]
            known = {PALETTE_COLUMNS * (K - 1): K for K in COEFFICIENTS[1:]}
            if width not in known:
                self.fail(f"a palette of {width} pixels in width isn't of degree 1 to 3")
            return COEFFICIENTS.index(known[width])
        bands = self._number(self._section("shN"), "bands")
        if bands not in range(len(COEFFICIENTS)):
            self.fail(f"harmonics of degree {bands} are announced: 0 to 3 were expected")
        return bands

    # ---- images ----------------------------------------------------------------------------------

    def rows(self, section: str, index: int = 0) -> Integer[np.ndarray, "N 4"]:
        """Return the pixels of an image, one for each Gaussian."""
        pixels = self._pixels(section, index)
        height, width = pixels.shape[:2]
        if height * width < self.count:
            size = f"{width} x {height} pixels"
            self.fail(f"{section} has {size}, too few for {self.count} Gaussians")
        return pixels.reshape(-1, 4)[: self.count]

    def palette(self) -> Optional[Integer[np.ndarray, "P K 3"]]:
        """Return the entries of the palette of harmonics, K for each; None without any."""
        if not (bands := self._bands()):
            return None
        coefficients, pixels = COEFFICIENTS[bands] - 1, self._pixels("shN", 0)
        height, width = pixels.shape[:2]
        count = height * PALETTE_COLUMNS
        if self.version != 1:
            count = self._number(self._section("shN"), "count")
        if width != PALETTE_COLUMNS * coefficients or height * PALETTE_COLUMNS < count:
            size = f"{width} x {height} pixels"
            self.fail(f"the palette of {count} entries of degree {bands} can't have {size}")
        return pixels[..., :3].reshape(-1, coefficients, 3)[:count]

    def _image(self, section: str, index: int) -> tuple[bytes, str]:
        """Return the content of an image, and its name."""
        files = self._section(section).get("files")
        if not isinstance(files, list) or len(files) <= index or not isinstance(files[index], str):
            self.fail(f"its meta.json names no image {index} of {section!r}")
        return self._member(files[index], self.size), files[index]

    def _pixels(self, section: str, index: int) -> Integer[np.ndarray, "H W 4"]:
        data, name = self._image(section, index)
        width, height = self._image_size(data, name)
        self._require_memory(BYTES_PER_PIXEL * width * height, f"{width} x {height} pixels")
        return self._decoded(data, (width, height), name)

    def _image_size(self, data: bytes, name: str) -> tuple[int, int]:
        """Return width and height in the header of a lossless WebP, or of a PNG."""
        kind, at = data[12:16], 20
        if FORMATS.get(data[:4]) == "PNG" and kind == b"IHDR" and len(data) >= 24:
            return struct.unpack_from(">II", data, 16)
        if data[:4] != b"RIFF" or data[8:12] != b"WEBP" or len(data) < 30:
            self.fail(f"{name[:40]!r} isn't a WebP or PNG image")
        if kind == b"VP8X":
            canvas = data[at + 4 : at + 7], data[at + 7 : at + 10]
            width, height = (int.from_bytes(value, "little") + 1 for value in canvas)
            return width, height
        if kind != b"VP8L":
            self.fail(f"{name[:40]!r} isn't a lossless WebP image, so its numbers are lost")
        bits = int.from_bytes(data[at + 1 : at + 5], "little")
        return (bits & 0x3FFF) + 1, (bits >> 14 & 0x3FFF) + 1

    def _decoded(
        self, data: bytes, size: tuple[int, int], name: str
    ) -> Integer[np.ndarray, "H W 4"]:
        from PIL import Image

        try:
            with Image.open(io.BytesIO(data), formats=[FORMATS[data[:4]]]) as image:
                if image.size != size or getattr(image, "n_frames", 1) != 1:
                    self.fail(f"{name[:40]!r} is of another size than its header says")
                return np.asarray(image.convert("RGBA"))
        except UserError:
            raise
        except Exception as error:  # Pillow raises errors of many types for damaged images
            self.fail(f"{name[:40]!r} can't be decoded ({type(error).__name__}: {error})")

    # ---- members of the archive ------------------------------------------------------------------

    def _member(self, name: str, most: int) -> bytes:
        """Return the content of a member, at most ``most`` bytes."""
        if self._zip is None:
            return self._beside(name, most)
        try:
            info = self._zip.getinfo(self._folder + name)
        except KeyError:
            self.fail(f"it has no {name[:40]!r}")
        if info.compress_type not in PACKINGS or info.flag_bits & 1:
            self.fail(f"{name[:40]!r} is encrypted, or packed by an unknown method")
        if info.file_size > most:
            self.fail(f"{name[:40]!r} has {info.file_size} bytes; at most {most} were expected")
        try:
            return self._zip.read(info)  # compares the checksum too
        except (*DAMAGED, OSError, ValueError) as error:
            self.fail(f"{name[:40]!r} can't be unpacked ({error})")

    def _beside(self, name: str, most: int) -> bytes:
        """Return the content of a file in the folder of ``meta.json``."""
        try:
            with self.path.with_name(name).open("rb") as file:
                data = file.read(most + 1)
        except (OSError, ValueError) as error:  # a name with a folder in it is a ValueError
            self.fail(f"{name[:40]!r}, which should lie beside it, can't be read ({error})")
        if len(data) > most:
            self.fail(f"{name[:40]!r} has more than the {most} bytes that were expected")
        return data

    def _require_memory(self, needed: float, content: str) -> None:
        needed = math.ceil(needed)
        require_file_memory(needed, self.size, f"SOG file {str(self.path)!r}", content)
