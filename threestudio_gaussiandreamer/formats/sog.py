"""SOG (Spatially Ordered Gaussians), PlayCanvas' format for the web: lossless WebP images
in a zip archive, about 15 bytes for a Gaussian of degree 0.

Gaussians are sorted along a Morton curve. Gaussian i is pixel i of each image but the palette's.
The images, with the entries of ``meta.json`` that they use:

=================  =================================================================================
means_l, means_u   low and high byte of positions: 65535 steps between ``mins`` and ``maxs`` of
                   sign(x) log(1 + abs(x))
quats              wxyz without its largest component: 255 (q / sqrt(2) + 0.5); alpha is 252 + the
                   index of that component
scales             index into ``scales.codebook`` of the logarithm of each axis' scale
sh0                indices into ``sh0.codebook`` of the constant harmonics; alpha is 255 opacity
shN_labels         number of an entry of the palette, low byte and high byte
shN_centroids      the palette, 64 entries a row, a pixel for each coefficient: indices into
                   ``shN.codebook``
=================  =================================================================================

``model`` is "antialiased" where the Gaussians were trained with antialiasing. The axes are those of
the PLY, as splat-transform writes and reads them (-y up), though the specification says y up
(developer.playcanvas.com, "The SOG Format").

Version 2 is written. Also read is version 1, which has no codebooks: the bytes of scales, sh0 and
shN are steps between ``mins`` and ``maxs``, those of sh0's alpha of the logit of the opacity; and
files without an archive, by their ``meta.json``.

JSON and images are checked before they are unpacked. Members are read into memory by the names in
``meta.json``; nothing is written to the disk, and the images of a folder lie beside its
``meta.json``, so names can't lead anywhere. Codebooks are by Lloyd's algorithm (k-means)."""

import io
import json
import math
import os
import struct
import zipfile
import zlib
from collections.abc import Sequence
from math import ceil, sqrt
from types import TracebackType
from typing import Any, NoReturn, Optional

import numpy as np
from jaxtyping import Float, Integer

from ..core.errors import UserError
from ..core.files import atomic_file, existing_file
from ..core.memory import require_file_memory
from ..gaussians.axes import VIEWER_UP
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.sh import COEFFICIENTS
from . import packing

SOG_UP = VIEWER_UP
ANTIALIASED = "antialiased"
MAX_PALETTE = 65536
MAX_DISTANCES = 3e8
"""Limit of the distances that an iteration of k-means computes, entries times Gaussians; at the
limit the palette takes one core about half a minute."""
MEMBER_DATE = (1980, 1, 1, 0, 0, 0)
"""Constant, so that equal clouds give equal files."""
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
ROUNDS = 12
"""Iterations; later ones hardly reduce the error."""
SHORT_WORK = 10**7
"""Distances that are computed without a progress bar."""
BLOCK = 2048
"""Vectors whose distances to all entries are computed at once."""


def write_sog(
    path: str | os.PathLike,
    gaussians: Gaussians,
    *,
    antialiased: bool = False,
    notes: Sequence[str] = (),
) -> None:
    """Write an SOG file atomically, without Gaussians that can't be drawn.

    Args:
        gaussians: with -y up.
        antialiased: whether they were trained with antialiasing.
        notes: ASCII lines, which other readers ignore.

    Raises:
        UserError: harmonics above degree 3, or the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    gaussians = gaussians.rows(packing.morton_order(gaussians.means))
    images, meta = _encoded(gaussians)
    meta |= {"model": ANTIALIASED} if antialiased else {}
    meta |= {"notes": list(notes)} if notes else {}
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, pixels in images.items():
            archive.writestr(zipfile.ZipInfo(name, MEMBER_DATE), _webp(pixels))
        archive.writestr(zipfile.ZipInfo("meta.json", MEMBER_DATE), json.dumps(meta))


def load_sog(path: str | os.PathLike) -> tuple[Gaussians, bool, list[str]]:
    """Read an SOG file, or by its ``meta.json`` one without an archive.

    Returns:
        the Gaussians, whether they were trained with antialiasing, and the notes of our writer.

    Raises:
        UserError: there is no such file, it is no SOG of version 1 or 2, it is damaged, or it
            would take more memory than the budget of its size.
    """
    with SogArchive(path) as archive:
        low, high = (archive.rows("means", index).astype(np.uint16) for index in (0, 1))
        quats, sh0 = archive.rows("quats"), archive.rows("sh0")
        colors = archive.values("sh0", sh0, 4)
        gaussians = Gaussians(
            means=_positions((low | high << 8)[:, :3], *archive.bounds()),
            quats=_quats(quats, archive),
            log_scales=archive.values("scales", archive.rows("scales")[:, :3]),
            logit_opacities=(
                colors[:, 3] if archive.version == 1 else packing.logits_of_bytes(sh0[:, 3])
            ),
            sh=_harmonics(colors[:, :3], archive),
        )
        return gaussians, archive.meta.get("model") == ANTIALIASED, archive.notes()


# ---- writing -------------------------------------------------------------------------------------


def _encoded(gaussians: Gaussians) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the images by file name, and what ``meta.json`` says."""
    positions, bounds = _position_steps(gaussians.means)
    scale_book, scale_rows = scalar_codebook(gaussians.log_scales, CODEBOOK)
    color_book, color_rows = scalar_codebook(gaussians.sh[:, 0], CODEBOOK)
    alphas = packing.opacity_bytes(gaussians.logit_opacities, 255)[:, None]
    images = {
        "means_l.webp": _image(positions & 255),
        "means_u.webp": _image(positions >> 8),
        "quats.webp": _image(_quat_bytes(gaussians.quats)),
        "scales.webp": _image(scale_rows),
        "sh0.webp": _image(np.concatenate([color_rows, alphas], axis=1)),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "threestudio-gaussiandreamer"},
        "count": len(gaussians.means),
        "means": bounds | {"files": ["means_l.webp", "means_u.webp"]},
        "scales": {"codebook": _numbers(scale_book), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _numbers(color_book), "files": ["sh0.webp"]},
    }
    if gaussians.sh.shape[1] > 1 and len(gaussians.means):
        palette_images, meta["shN"] = _palette(gaussians.sh[:, 1:])
        images |= palette_images
    return images, meta


def _numbers(book: Float[np.ndarray, " B"]) -> list[float]:
    """Round a codebook to 7 digits for the JSON, about the precision of float32."""
    return [float(f"{value:.7g}") for value in book]


def _position_steps(
    means: Float[np.ndarray, "N 3"],
) -> tuple[Integer[np.ndarray, "N 3"], dict[str, list[float]]]:
    logs = np.sign(means) * np.log1p(np.abs(means.astype(np.float64)))
    low, high = (logs.min(axis=0), logs.max(axis=0)) if len(logs) else (np.zeros(3), np.zeros(3))
    size = np.where(high > low, high - low, 1)
    steps = np.rint((logs - low) / size * 65535).astype(np.uint16)
    return steps, {"mins": low.tolist(), "maxs": high.tolist()}


def _quat_bytes(quats: Float[np.ndarray, "N 4"]) -> Integer[np.ndarray, "N 4"]:
    largest, others = packing.without_largest(packing.unit_quats(quats))
    tags = (FIRST_TAG + largest).astype(np.uint8)
    return np.concatenate([packing.to_byte(255 * (others / sqrt(2) + 0.5)), tags[:, None]], axis=1)


def _palette(rest: Float[np.ndarray, "N K 3"]) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the images of the harmonics above the constant one, and their entry in the JSON."""
    count, coefficients = rest.shape[:2]
    entries, labels = vector_codebook(rest.reshape(count, -1), palette_size(count))
    book, rows = scalar_codebook(entries.reshape(-1, coefficients, 3), CODEBOOK)
    missing = -len(rows) % PALETTE_COLUMNS
    pixels = np.pad(rows, ((0, missing), (0, 0), (0, 0)))
    pixels = pixels.reshape(-1, PALETTE_COLUMNS * coefficients, 3)
    opaque = np.full((*pixels.shape[:2], 1), 255, np.uint8)
    images = {
        "shN_centroids.webp": np.concatenate([pixels, opaque], axis=2),
        "shN_labels.webp": _image(np.stack([labels & 255, labels >> 8, 0 * labels], axis=1)),
    }
    meta = {
        "count": len(entries),
        "bands": COEFFICIENTS.index(coefficients + 1),
        "codebook": _numbers(book),
        "files": list(images),
    }
    return images, meta


def palette_size(count: int) -> int:
    """Return the number of palette entries for ``count`` Gaussians: as many up to 1024, else the
    largest power of two that ``count``, MAX_DISTANCES and MAX_PALETTE allow, at least 1024.
    """
    size = 2 ** (count.bit_length() - 1) if count > 1024 else count
    while size > 1024 and size * count > MAX_DISTANCES:
        size //= 2
    return min(size, MAX_PALETTE)


def _image(rows: Integer[np.ndarray, "N C"]) -> Integer[np.ndarray, "H W 4"]:
    """Lay rows out as pixels; width and height are multiples of 4, alpha is 255 unless given."""
    width = 4 * max(ceil(sqrt(len(rows)) / 4), 1)
    height = 4 * max(ceil(len(rows) / width / 4), 1)
    pixels = np.zeros((width * height, 4), np.uint8)
    pixels[:, 3] = 255
    pixels[: len(rows), : rows.shape[1]] = rows
    return pixels.reshape(height, width, 4)


def _webp(pixels: Integer[np.ndarray, "H W 4"]) -> bytes:
    from PIL import Image

    buffer = io.BytesIO()
    # exact: keep the RGB of pixels with alpha 0, which hold data here
    Image.fromarray(pixels, "RGBA").save(buffer, "WEBP", lossless=True, exact=True, method=4)
    return buffer.getvalue()


# ---- the archive ---------------------------------------------------------------------------------


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


# ---- reading -------------------------------------------------------------------------------------


def _positions(
    steps: Integer[np.ndarray, "N 3"], low: Float[np.ndarray, "3"], high: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "N 3"]:
    logs = low + (high - low) * (steps / 65535)
    return (np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32)


def _quats(rows: Integer[np.ndarray, "N 4"], archive: SogArchive) -> Float[np.ndarray, "N 4"]:
    largest = rows[:, 3].astype(np.int64) - FIRST_TAG
    if (largest < 0).any():
        archive.fail("a quaternion's index of its largest component isn't 0 to 3: it is damaged")
    return packing.with_largest(largest, (rows[:, :3] / 255 - 0.5) * sqrt(2))


def _harmonics(
    constant: Float[np.ndarray, "N 3"], archive: SogArchive
) -> Float[np.ndarray, "N K 3"]:
    if (entries := archive.palette()) is None:
        return constant[:, None]
    pixels = archive.rows("shN", 1).astype(np.int64)
    labels = pixels[:, 0] | pixels[:, 1] << 8
    if len(labels) and labels.max() >= len(entries):
        archive.fail(f"a Gaussian has entry {labels.max()} of a palette of {len(entries)}")
    sh = np.empty((len(constant), 1 + entries.shape[1], 3), np.float32)
    sh[:, 0] = constant
    sh[:, 1:] = archive.values("shN", entries[labels], 1)
    return sh


# ---- codebooks -----------------------------------------------------------------------------------


def scalar_codebook(
    values: Float[np.ndarray, "*shape"], size: int = 256
) -> tuple[Float[np.ndarray, " size"], Integer[np.ndarray, "*shape"]]:
    """Return ``size`` ascending values and the index of the nearest one for each of ``values``.

    Up to ``size`` different values are kept exactly.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    if not len(ordered):
        return np.zeros(size, np.float32), np.zeros(values.shape, np.uint8)
    distinct = np.unique(ordered)
    if len(distinct) <= size:
        book = np.pad(distinct, (0, size - len(distinct)), "edge")
    else:
        book = _lloyd(ordered, distinct, size)
    book = book.astype(np.float32)
    middles = (book[1:] + book[:-1]) / 2
    return book, np.searchsorted(middles, values).astype(np.uint8)


def _lloyd(
    ordered: Float[np.ndarray, " N"], distinct: Float[np.ndarray, " D"], size: int
) -> Float[np.ndarray, " size"]:
    """Move each value to the mean of what it stands for.

    The start is as dense as the third root of the values' density, the optimum for many values
    (Panter and Dite 1951).
    """
    mass = np.concatenate([[0], np.cumsum(np.diff(distinct) ** (2 / 3))])
    book = np.interp(np.linspace(0, mass[-1], size), mass, distinct)
    sums = np.concatenate([[0], np.cumsum(ordered)])
    for _ in range(ROUNDS):
        ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
        ends = np.concatenate([[0], ends, [len(ordered)]])
        counts = np.diff(ends)
        means = np.diff(sums[ends]) / np.maximum(counts, 1)
        book = np.sort(np.where(counts > 0, means, book))
    return book


def vector_codebook(
    vectors: Float[np.ndarray, "N D"], size: int
) -> tuple[Float[np.ndarray, "size D"], Integer[np.ndarray, " N"]]:
    """Return ``size`` vectors and the index of the nearest one for each of ``vectors``; k-means
    from a fixed seed. Up to ``size`` vectors are kept exactly.
    """
    if len(vectors) <= size:
        return vectors, np.arange(len(vectors))
    from tqdm import tqdm

    start = np.random.default_rng(0).choice(len(vectors), size, replace=False)
    book = vectors[np.sort(start)].astype(np.float32)
    rounds = range(ROUNDS // 2)
    short = len(vectors) * size < SHORT_WORK
    for _ in tqdm(rounds, "palette of harmonics", leave=False, disable=short or None):
        nearest = _nearest(vectors, book)
        counts = np.bincount(nearest, minlength=size)[:, None]
        columns = (np.bincount(nearest, column, size) for column in vectors.T)
        means = np.stack(list(columns), axis=1) / np.maximum(counts, 1)
        book = np.where(counts > 0, means, book).astype(np.float32)
    return book, _nearest(vectors, book)


def _nearest(
    vectors: Float[np.ndarray, "N D"], book: Float[np.ndarray, "K D"]
) -> Integer[np.ndarray, " N"]:
    squares = (book**2).sum(axis=1)
    starts = range(0, len(vectors), BLOCK)
    blocks = (vectors[at : at + BLOCK] for at in starts)
    return np.concatenate([(squares - 2 * block @ book.T).argmin(axis=1) for block in blocks])
