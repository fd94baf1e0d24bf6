"""Compressed PLY, PlayCanvas' chunked layout, described in their manual, "The Compressed PLY
Format". Elements, binary little-endian: ``chunk``, minima and maxima of 256 Gaussians' positions,
logarithms of scales and, but in files of the first version, colours; ``vertex``, four u32 a
Gaussian; and ``sh`` with f_rest as bytes, absent at degree 0. Axes as those of a PLY."""

import os
from collections.abc import Sequence
from math import ceil, sqrt

import numpy as np
from jaxtyping import Float, Integer

from ..core.files import atomic_file
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.sh import COEFFICIENTS, rgb_to_sh0, sh0_to_rgb
from . import packing
from .ply import header_bytes, header_of, read_header, read_rows
from .reading import reading, require

CHUNK = 256
"""Gaussians of a chunk."""
LIMITS = tuple(
    f"{bound}_{name}"
    for names in (("x", "y", "z"), ("scale_x", "scale_y", "scale_z"), ("r", "g", "b"))
    for bound in ("min", "max")
    for name in names
)
PACKED = ("packed_position", "packed_rotation", "packed_scale", "packed_color")
BITS = (11, 10, 11)
SH_REACH = 4.0
"""Harmonics above degree 0 are clipped to [-SH_REACH, SH_REACH]."""
MAX_STORED_LOG = 20.0
"""Logarithms of scales are clipped to plus and minus this, as other readers expect."""


def write_compressed_ply(
    path: str | os.PathLike, gaussians: Gaussians, comments: Sequence[str] = ()
) -> None:
    """Write a compressed PLY atomically, along a Morton curve, of the Gaussians that can be drawn.

    Args:
        comments: ASCII lines for the header.

    Raises:
        UserError: the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    gaussians = gaussians.rows(packing.morton_order(gaussians.means))
    count, coefficients = len(gaussians.means), 3 * (gaussians.sh.shape[1] - 1)
    elements = [("chunk", ceil(count / CHUNK), [(name, "float") for name in LIMITS])]
    elements += [("vertex", count, [(name, "uint") for name in PACKED])]
    harmonics = [(f"f_rest_{index}", "uchar") for index in range(coefficients)]
    elements += [("sh", count, harmonics)] if coefficients else []
    by_channel = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, coefficients)
    rest = packing.to_byte(np.floor(256 * (by_channel / (2 * SH_REACH) + 0.5)))
    limits, words = _packed(gaussians)
    with atomic_file(path) as file:
        file.write(header_bytes(elements, comments))
        file.writelines(array.tobytes() for array in (limits, words, rest))


def is_compressed_ply(path: str | os.PathLike) -> bool:
    """Return whether the file is a PLY with the elements of a compressed one."""
    found = {element.name: element.properties for element in header_of(path).elements}
    return "chunk" in found and [entry.name for entry in found.get("vertex", [])][:1] == [PACKED[0]]


def read_compressed_ply(path: str | os.PathLike) -> Gaussians:
    """Read a compressed PLY, in the file's axes.

    Raises:
        UserError: there is no such file, it is no compressed PLY, or it is damaged.
    """
    with reading(path, "compressed PLY") as file, open(file, "rb") as opened:
        header, data = read_header(opened), opened.read()
        counts = {entry.name: entry.count for entry in header.elements}
        known = {(*counts,)} & {("chunk", "vertex"), ("chunk", "vertex", "sh")}
        require(
            bool(known) and header.encoding != "ascii", "it isn't binary, or has other elements"
        )
        count = counts["vertex"]
        rest = [tuple(f"f_rest_{i}" for i in range(3 * (k - 1))) for k in COEFFICIENTS[1:]]
        layouts = {
            "chunk": ((LIMITS, LIMITS[:12]), "f4", ceil(count / CHUNK)),
            "vertex": ((PACKED,), "u4", count),
            "sh": (rest, "u1", count),
        }
        elements, at = {}, 0
        for element in header.elements:
            layouts_known, kind, rows = layouts[element.name]
            names = tuple(entry.name for entry in element.properties)
            usual = all(entry.type == kind and not entry.count_type for entry in element.properties)
            said = f"{element.name!r} has other properties than those of the format, or other rows"
            require(usual and names in layouts_known and element.count == rows, said)
            columns, at = read_rows(data, at, element, header.encoding)
            values = [column.values for column in columns.values()]
            elements[element.name] = np.stack(values, axis=1)
    packed, limits = elements["vertex"], elements["chunk"].astype(np.float64)
    chunks = np.arange(len(packed)) // CHUNK
    # colours without limits are in [0, 1]
    usual = np.tile(np.repeat(np.float64([0, 1]), 3), (len(limits), 1))
    limits = np.concatenate([limits, usual[:, : len(LIMITS) - limits.shape[1]]], axis=1)
    limits = limits.reshape(-1, 3, 2, 3)

    def between(fractions: Float[np.ndarray, "N 3"], kind: int) -> Float[np.ndarray, "N 3"]:
        low, high = limits[chunks, kind].transpose(1, 0, 2)
        with np.errstate(invalid="ignore", over="ignore"):  # limits of damaged files
            return low * (1 - fractions) + high * fractions

    position, rotation, scale, color = packed.astype(np.int64).T
    rgba = (color[:, None] >> np.array([24, 16, 8, 0]) & 255).astype(np.uint8)
    constant = rgb_to_sh0(between(rgba[:, :3] / 255, 2))[:, None].astype(np.float32)
    rest = elements.get("sh", np.empty((count, 0), np.uint8))
    # the middle of each step; 0 and 255 are the limits themselves
    values = (rest.astype(np.float32) + np.float32(0.5)) / 256
    values[rest == 0], values[rest == 255] = 0, 1
    values = (values - np.float32(0.5)) * np.float32(2 * SH_REACH)
    values = values.reshape(len(rest), 3, rest.shape[1] // 3).transpose(0, 2, 1)
    others = (_fractions(rotation, (10, 10, 10)) - 0.5) * sqrt(2)
    return Gaussians(
        means=between(_fractions(position, BITS), 0).astype(np.float32),
        quats=packing.with_largest(rotation >> 30, others),
        log_scales=between(_fractions(scale, BITS), 1).astype(np.float32),
        logit_opacities=packing.logits_of_bytes(rgba[:, 3]),
        sh=np.concatenate([constant, values], axis=1),
    )


def _packed(
    gaussians: Gaussians,
) -> tuple[Float[np.ndarray, "C 3 2 3"], Integer[np.ndarray, "N 4"]]:
    """Return minima and maxima of each chunk, filled up with the last Gaussian, and the words."""
    scales = gaussians.log_scales.clip(-MAX_STORED_LOG, MAX_STORED_LOG)
    values = np.stack([gaussians.means, scales, sh0_to_rgb(gaussians.sh[:, 0])], axis=1)
    count, missing = len(values), -len(values) % CHUNK
    values = np.pad(values, ((0, missing), (0, 0), (0, 0)), "edge") if missing else values
    values = values.astype(np.float32).reshape(-1, CHUNK, 3, 3)
    limits = np.stack([values.min(axis=1), values.max(axis=1)], axis=2)
    low, size = limits[:, None, :, 0], np.ptp(limits, axis=2)[:, None]
    fractions = (values - low) / np.where(size > 0, size, 1)
    position, scale, color = fractions.reshape(-1, 3, 3)[:count].transpose(1, 0, 2)
    alpha = packing.opacity_bytes(gaussians.logit_opacities)
    rgba = np.concatenate([packing.to_byte(255 * color), alpha[:, None]], axis=1)
    largest, others = packing.without_largest(packing.unit_quats(gaussians.quats))
    rotation = _word(others / sqrt(2) + 0.5, (10, 10, 10)) | largest.astype(np.uint32) << 30
    color = rgba[:, ::-1].copy().view("<u4")[:, 0]
    words = np.stack([_word(position, BITS), rotation, _word(scale, BITS), color], axis=1)
    return limits.astype("<f4"), words.astype("<u4")


def _word(fractions: Float[np.ndarray, "N F"], bits: Sequence[int]) -> Integer[np.ndarray, " N"]:
    """Pack fractions in [0, 1] into one integer each, the first in the highest bits."""
    word = np.zeros(len(fractions), np.uint32)
    for fraction, width in zip(fractions.T, bits, strict=True):
        most = (1 << width) - 1
        word = word << width | np.rint(np.clip(fraction, 0, 1) * most).astype(np.uint32)
    return word


def _fractions(words: Integer[np.ndarray, " N"], bits: Sequence[int]) -> np.ndarray:
    """Invert :func:`_word`: (N, F) in [0, 1]."""
    shifts = np.cumsum(bits[::-1])[::-1] - bits
    most = (1 << np.array(bits)) - 1
    return (words[:, None] >> shifts & most) / most
