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
files without an archive, by their ``meta.json``."""

import io
import json
import os
import zipfile
from collections.abc import Sequence
from math import ceil, sqrt
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from ..core.files import atomic_file
from ..gaussians.axes import VIEWER_UP
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.sh import COEFFICIENTS
from . import packing
from .codebook import scalar_codebook, vector_codebook
from .sog_archive import CODEBOOK, FIRST_TAG, PALETTE_COLUMNS, SogArchive

SOG_UP = VIEWER_UP
ANTIALIASED = "antialiased"
MAX_PALETTE = 65536
MAX_DISTANCES = 3e8
"""Limit of the distances that an iteration of k-means computes, entries times Gaussians; at the
limit the palette takes one core about half a minute."""
MEMBER_DATE = (1980, 1, 1, 0, 0, 0)
"""Constant, so that equal clouds give equal files."""


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


def read_sog(path: str | os.PathLike) -> Gaussians:
    """Read the Gaussians of an SOG file, with -y up; see :func:`load_sog`."""
    return load_sog(path)[0]


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
