"""SOG (Spatially Ordered Gaussians), PlayCanvas' format for the web: lossless WebP images
in a zip archive (developer.playcanvas.com, "The SOG Format").

Gaussian i, along a Morton curve, is pixel i of each image but the palette's. The axes are those of
the PLY, as splat-transform writes and reads them (-y up), though the specification says y up.

Version 2 is written. Also read are version 1, without codebooks: the bytes of scales, sh0, whose
alpha is the logit of the opacity, and shN are steps between ``mins`` and ``maxs``; and files
without an archive, by their ``meta.json``, from whose folder alone images are read."""

import io
import json
import os
import zipfile
from collections.abc import Sequence
from contextlib import ExitStack
from math import ceil, sqrt
from pathlib import Path
from typing import Any, Optional

import numpy as np
from jaxtyping import Float, Integer

from ..core.files import atomic_file
from ..gaussians.axes import VIEWER_UP
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.sh import COEFFICIENTS
from . import packing
from .packing import ANTIALIASED
from .reading import reading, require, require_file_memory, whole_number

SOG_UP = VIEWER_UP
ANTIALIASED_MODEL = "antialiased"
MAX_PALETTE = 65536
MAX_DISTANCES = 3e8
"""Of entries to Gaussians, in an iteration of k-means: about half a minute of one core in all."""
MEMBER_DATE = (1980, 1, 1, 0, 0, 0)
"""Constant, so that equal clouds give equal files."""
VERSIONS = 1, 2
MEANS = ["means_l.webp", "means_u.webp"]
CODEBOOK = 256
PALETTE_COLUMNS = 64
FIRST_TAG = 252
"""Alpha of a quaternion whose largest component is number 0."""
DECODED_BYTES, DECODED_BYTES_PER_HARMONIC = 200, 24
"""Bytes of memory that reading takes per Gaussian, and per harmonic of it, with a safety margin."""
PACKINGS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
ROUNDS = 12
"""Iterations; later ones hardly reduce the error."""
BLOCK = 2048
"""Vectors whose distances to all entries are computed at once."""


def write_sog(path: str | os.PathLike, gaussians: Gaussians, notes: Sequence[str] = ()) -> None:
    """Write an SOG file atomically, without Gaussians that can't be drawn.

    Args:
        gaussians: with -y up.
        notes: ASCII lines, which other readers ignore; ``packing.ANTIALIASED`` sets the model.

    Raises:
        UserError: harmonics above degree 3, or the file can't be written.
    """
    from PIL import Image

    gaussians = finite(gaussians, str(path))
    images, meta = _encoded(gaussians.rows(packing.morton_order(gaussians.means)))
    others = [note for note in notes if note != ANTIALIASED]
    meta |= {"model": ANTIALIASED_MODEL} if ANTIALIASED in notes else {}
    meta |= {"notes": others} if others else {}
    with atomic_file(path) as file, zipfile.ZipFile(file, "w") as archive:
        for name, pixels in images.items():
            # exact: keep the RGB of pixels with alpha 0, which hold data here
            webp = {"lossless": True, "exact": True, "method": 4}
            Image.fromarray(pixels, "RGBA").save(buffer := io.BytesIO(), "WEBP", **webp)
            archive.writestr(zipfile.ZipInfo(name, MEMBER_DATE), buffer.getvalue())
        archive.writestr(zipfile.ZipInfo("meta.json", MEMBER_DATE), json.dumps(meta))


def read_sog(path: str | os.PathLike) -> tuple[Gaussians, list[str]]:
    """Read an SOG file, or by its ``meta.json`` one without an archive; also the notes.

    Raises:
        UserError: there is no such file, it is no SOG of version 1 or 2, or it is damaged.
    """
    with reading(path, "SOG file") as file, ExitStack() as opened:
        unpacked = file.suffix.lower() == ".json"
        archive = _Archive(file, None if unpacked else opened.enter_context(zipfile.ZipFile(file)))
        low, high = (archive.rows("means", index).astype(np.uint16) for index in (0, 1))
        least, most = (archive.floats("means", key, 3) for key in ("mins", "maxs"))
        logs = least + (most - least) * ((low | high << 8)[:, :3] / 65535)
        quats, sh0 = archive.rows("quats"), archive.rows("sh0")
        largest = quats[:, 3].astype(np.int64) - FIRST_TAG
        require((largest >= 0).all(), "a quaternion names no largest component: it is damaged")
        colors = archive.values("sh0", sh0, 4)
        sh = colors[:, None, :3]
        if archive.bands:
            entries, pixels = archive.palette(), archive.rows("shN", 1).astype(np.int64)
            sh = np.empty((archive.count, 1 + entries.shape[1], 3), np.float32)
            sh[:, 0] = colors[:, :3]
            sh[:, 1:] = archive.values("shN", entries[pixels[:, 0] | pixels[:, 1] << 8], 1)
        logits = colors[:, 3] if archive.version == 1 else packing.logits_of_bytes(sh0[:, 3])
        gaussians = Gaussians(
            means=(np.sign(logs) * np.expm1(np.abs(logs))).astype(np.float32),
            quats=packing.with_largest(largest, (quats[:, :3] / 255 - 0.5) * sqrt(2)),
            log_scales=archive.values("scales", archive.rows("scales")[:, :3]),
            logit_opacities=logits,
            sh=sh,
        )
        notes = archive.meta.get("notes")
        notes = [note for note in notes if isinstance(note, str)] if type(notes) is list else []
        return gaussians, notes + [ANTIALIASED] * (archive.meta.get("model") == ANTIALIASED_MODEL)


def _encoded(gaussians: Gaussians) -> tuple[dict[str, np.ndarray], dict[str, Any]]:
    """Return the images by file name, and what ``meta.json`` says."""
    count, means = len(gaussians.means), gaussians.means.astype(np.float64)
    logs = np.sign(means) * np.log1p(np.abs(means))
    low, high = (logs.min(axis=0), logs.max(axis=0)) if count else (np.zeros(3), np.zeros(3))
    steps = np.rint((logs - low) / np.where(high > low, high - low, 1) * 65535).astype(np.uint16)
    largest, others = packing.without_largest(packing.unit_quats(gaussians.quats))
    tags = (FIRST_TAG + largest).astype(np.uint8)[:, None]
    quats = np.concatenate([packing.to_byte(255 * (others / sqrt(2) + 0.5)), tags], axis=1)
    scale_book, scale_rows = scalar_codebook(gaussians.log_scales, CODEBOOK)
    color_book, color_rows = scalar_codebook(gaussians.sh[:, 0], CODEBOOK)
    alphas = packing.opacity_bytes(gaussians.logit_opacities, 255)[:, None]
    images = {
        MEANS[0]: _image(steps & 255),
        MEANS[1]: _image(steps >> 8),
        "quats.webp": _image(quats),
        "scales.webp": _image(scale_rows),
        "sh0.webp": _image(np.concatenate([color_rows, alphas], axis=1)),
    }
    meta = {
        "version": 2,
        "asset": {"generator": "threestudio-gaussiandreamer"},
        "count": count,
        "means": {"mins": low.tolist(), "maxs": high.tolist(), "files": MEANS},
        "scales": {"codebook": _numbers(scale_book), "files": ["scales.webp"]},
        "quats": {"files": ["quats.webp"]},
        "sh0": {"codebook": _numbers(color_book), "files": ["sh0.webp"]},
    }
    if gaussians.sh.shape[1] > 1 and count:
        palette, meta["shN"] = _palette(gaussians.sh[:, 1:])
        images |= palette
    return images, meta


def _numbers(book: Float[np.ndarray, " B"]) -> list[float]:
    """Round a codebook to 7 digits for the JSON, about the precision of float32."""
    return [float(f"{value:.7g}") for value in book]


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


class _Archive:
    """An SOG file, or the ``meta.json`` of an unpacked one; version and memory are checked."""

    def __init__(self, path: Path, archive: Optional[zipfile.ZipFile]) -> None:
        self.path, self._zip = path, archive
        beside = () if archive else path.parent.iterdir()
        files = [path, *(file for file in beside if file.suffix in (".webp", ".png"))]
        self.size = sum(file.stat().st_size for file in files)
        names = archive.namelist() if archive else []
        found = [name for name in names if name.split("/")[-1] == "meta.json"]
        # a folder that was packed by hand is in the names of its files
        self._folder = min(found, key=len, default="meta.json").removesuffix("meta.json")
        data = self._member("meta.json" if archive else path.name, 1 << 19)
        self.meta: dict[str, Any] = json.loads(data.decode("utf-8"))
        self.version = self.meta.get("version", 1)
        said = f"it is of version {str(self.version)[:20]}; version 1 or 2 was expected"
        require(self.version in VERSIONS, said)
        shape = self.meta["means"].get("shape") if self.version == 1 else None
        counted = {"count": shape[0]} if isinstance(shape, list) and shape else self.meta
        self.count, self.bands = whole_number(counted, "count"), 0
        if self.meta.get("shN") is not None and self.version == 1:
            width = self._pixels("shN", 0).shape[1]
            self.bands = [PALETTE_COLUMNS * (k - 1) for k in COEFFICIENTS].index(width or -1)
        elif self.meta.get("shN") is not None:
            self.bands = whole_number(self.meta["shN"], "bands")
        said = f"harmonics of degree {self.bands}: 0 to 3 were expected"
        require(self.bands < len(COEFFICIENTS), said)
        each = DECODED_BYTES + DECODED_BYTES_PER_HARMONIC * COEFFICIENTS[self.bands]
        require_file_memory(self.count * each, self.size, f"{self.count} Gaussians")

    def values(
        self, section: str, pixels: Integer[np.ndarray, "*N C"], channels: int = 3
    ) -> Float[np.ndarray, "*N C"]:
        """Return what the bytes of an image stand for: entries of a codebook, in version 1 steps
        between ``mins`` and ``maxs`` of each of ``channels`` (1: of all).
        """
        if self.version == 1:
            low, high = (self.floats(section, key, channels) for key in ("mins", "maxs"))
            book = np.linspace(low, high, CODEBOOK)
        else:
            book = self.floats(section, "codebook", CODEBOOK)[:, None]
        book = book.astype(np.float32)
        if book.shape[1] == 1:  # indices by a second axis take memory
            return book[:, 0][pixels]
        return book[pixels, np.arange(pixels.shape[-1]) % book.shape[1]]

    def floats(self, section: str, key: str, count: int) -> Float[np.ndarray, " C"]:
        """Return ``count`` numbers of the JSON."""
        numbers = np.atleast_1d(np.array(self.meta[section][key], np.float64)).clip(-1e38, 1e38)
        usual = numbers.shape == (count,) and np.isfinite(numbers).all()
        require(usual, f"{key} of {section} should be {count} numbers")
        return numbers

    def rows(self, section: str, index: int = 0) -> Integer[np.ndarray, "N 4"]:
        """Return the pixels of an image, one for each Gaussian."""
        pixels = self._pixels(section, index).reshape(-1, 4)
        said = f"{section} has {len(pixels)} pixels, too few for {self.count} Gaussians"
        require(len(pixels) >= self.count, said)
        return pixels[: self.count]

    def palette(self) -> Integer[np.ndarray, "P K 3"]:
        """Return the entries of the palette of harmonics, K for each."""
        coefficients, pixels = COEFFICIENTS[self.bands] - 1, self._pixels("shN", 0)
        height, width = pixels.shape[:2]
        count = height * PALETTE_COLUMNS
        if self.version != 1:
            count = whole_number(self.meta["shN"], "count")
        fits = width == PALETTE_COLUMNS * coefficients and height * PALETTE_COLUMNS >= count
        require(fits, f"the palette of {count} entries can't have {width} x {height} pixels")
        return pixels[..., :3].reshape(-1, coefficients, 3)[:count]

    def _pixels(self, section: str, index: int) -> Integer[np.ndarray, "H W 4"]:
        from PIL import Image

        data = self._member(self.meta[section]["files"][index], self.size)
        lossless = data[12:16] != b"VP8 "
        require(lossless, "one of its images isn't a lossless WebP image: its numbers are lost")
        with Image.open(io.BytesIO(data), formats=["WEBP", "PNG"]) as image:
            width, height = image.size
            size = f"{width} x {height} pixels"
            require_file_memory(24 * width * height, self.size, size)  # while it is decoded
            return np.asarray(image.convert("RGBA"))

    def _member(self, name: str, most: int) -> bytes:
        """Return the content of a member, or of a file beside ``meta.json``, at most ``most``."""
        if not self._zip:
            with self.path.with_name(name).open("rb") as file:  # refuses names with folders
                data = file.read(most + 1)
            require(len(data) <= most, f"{name!r} has more than {most} bytes")
            return data
        info = self._zip.getinfo(self._folder + name)
        usual = info.compress_type in PACKINGS and info.file_size <= most
        require(usual, f"{name[:40]!r} has more than {most} bytes, or is packed in another way")
        return self._zip.read(info)  # compares the checksum too


def scalar_codebook(
    values: Float[np.ndarray, "*shape"], size: int = 256
) -> tuple[Float[np.ndarray, " size"], Integer[np.ndarray, "*shape"]]:
    """Return ``size`` ascending values and the index of the nearest one for each of ``values``.

    Up to ``size`` different values are kept exactly. Else the density is at first the third root of
    the values', the optimum for many of them (Panter and Dite 1951), and each value moves to the
    mean of what it stands for.
    """
    ordered = np.sort(values, axis=None).astype(np.float64)
    if not len(ordered):
        return np.zeros(size, np.float32), np.zeros(values.shape, np.uint8)
    distinct = np.unique(ordered)
    if len(distinct) <= size:
        book = np.pad(distinct, (0, size - len(distinct)), "edge")
    else:
        mass = np.concatenate([[0], np.cumsum(np.diff(distinct) ** (2 / 3))])
        book = np.interp(np.linspace(0, mass[-1], size), mass, distinct)
        sums = np.concatenate([[0], np.cumsum(ordered)])
        for _ in range(ROUNDS):
            ends = np.searchsorted(ordered, (book[1:] + book[:-1]) / 2)
            ends = np.concatenate([[0], ends, [len(ordered)]])
            counts = np.diff(ends)
            means = np.diff(sums[ends]) / np.maximum(counts, 1)
            book = np.sort(np.where(counts > 0, means, book))
    book = book.astype(np.float32)
    middles = (book[1:] + book[:-1]) / 2
    return book, np.searchsorted(middles, values).astype(np.uint8)


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
    hidden = len(vectors) * size < 10**7 or None
    for _ in tqdm(range(ROUNDS // 2), "palette of harmonics", leave=False, disable=hidden):
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
    blocks = (vectors[at : at + BLOCK] for at in range(0, len(vectors), BLOCK))
    return np.concatenate([(squares - 2 * block @ book.T).argmin(axis=1) for block in blocks])
