"""PLY files of 3D Gaussians and of coloured points.

Gaussians are written in the usual layout of 3D Gaussian splatting (little-endian float32):
``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``, where ``f_dc``/``f_rest`` are
spherical harmonics (``f_rest`` channel by channel), ``opacity`` is a logit, ``scale`` a logarithm
and ``rot`` a quaternion wxyz. When reading, ``f_rest`` may be missing; so may ``scale_2``, of 2D
Gaussians, and ``f_dc`` where ``red green blue`` are there, as nerfstudio's exporter writes. The
3D filter of Mip-Splatting, ``filter_3D``, is applied; rows of nothing but zeros are left out."""

import logging
import os
from collections.abc import Collection, Sequence

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError
from ..gaussians.gaussians import Gaussians, finite, usable
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import rgb_to_sh0, sh0_colors
from . import packing
from .ply_table import (
    MAX_HEADER_BYTES,
    NUMBER_TYPES,
    PlyTable,
    header_bytes,
    read_header,
    write_table,
)

logger = logging.getLogger(__name__)

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH_CONSTANT = ("f_dc_0", "f_dc_1", "f_dc_2")
LOG_SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
GAUSSIAN = (*MEANS, *SH_CONSTANT, "opacity", *LOG_SCALES, *QUATS)
COLORS = ("red", "green", "blue")
EXACT_COLORS = ("float_red", "float_green", "float_blue")
FILTER = "filter_3D"
FLAT_LOG_SCALE = float(np.log(1e-6))
"""Logarithm of the third scale of 2D Gaussians, which files leave out or store as -inf."""
MIN_UNIT, MAX_UNIT = -0.01, 2.0
"""Range of colours that are taken for numbers in [0, 1], to which they are clipped: interpolation
and high dynamic range exceed it a little.
"""
COMPRESSED = "packed_position"
"""A property by which compressed PLY files are recognised."""


# --------------------------------------------------------------------------------------------------
# writing


def write_gaussians(
    path: str | os.PathLike, gaussians: Gaussians, comments: Sequence[str] = ()
) -> None:
    """Write Gaussians as float32, atomically, without those that can't be drawn.

    Args:
        path: the file; its folder must exist.
        comments: ASCII lines for the header.

    Raises:
        ValueError: the shapes of the arrays don't agree.
        UserError: the file can't be written.
    """
    gaussians = finite(_as_float32(gaussians), str(path))
    properties = gaussian_properties(gaussians.sh.shape[1])
    write_table(path, properties, gaussian_columns(gaussians), comments)


def gaussians_size(count: int, harmonics: int, comments: Sequence[str] = ()) -> int:
    """Return the size in bytes of the file that :func:`write_gaussians` writes for ``count``
    Gaussians with (degree + 1)^2 ``harmonics`` each.
    """
    properties = gaussian_properties(harmonics)
    return len(header_bytes(properties, count, comments)) + 4 * len(properties) * count


def gaussian_properties(harmonics: int) -> list[tuple[str, str]]:
    """Return name and type of each column of Gaussians with (degree + 1)^2 ``harmonics``."""
    rest = (f"f_rest_{i}" for i in range(3 * (harmonics - 1)))
    names = (*MEANS, *NORMALS, *SH_CONSTANT, *rest, "opacity", *LOG_SCALES, *QUATS)
    return [(name, "float") for name in names]


def gaussian_columns(gaussians: Gaussians) -> Float[np.ndarray, "N P"]:
    """Return the values of the columns of :func:`gaussian_properties`; normals are zero."""
    count, harmonics = gaussians.sh.shape[:2]
    by_channel = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics - 1))
    columns = [
        gaussians.means,
        np.zeros_like(gaussians.means),
        gaussians.sh[:, 0],
        by_channel,
        gaussians.logit_opacities[:, None],
        gaussians.log_scales,
        gaussians.quats,
    ]
    return np.concatenate(columns, axis=1)


def read_comments(path: str | os.PathLike) -> list[str]:
    """Return the comments in the header of a PLY file; empty if it isn't a PLY file."""
    with open(path, "rb") as file:
        head = file.read(MAX_HEADER_BYTES).partition(b"end_header")[0].decode("latin-1")
    lines = head.splitlines() if head.startswith("ply") else []
    return [line.removeprefix("comment ").strip() for line in lines if line.startswith("comment ")]


def padded_sh(sh: Float[np.ndarray, "N K 3"], degree: int) -> Float[np.ndarray, "N L 3"]:
    """Pad harmonics with zeros up to ``degree``; higher ones are kept."""
    missing = max((degree + 1) ** 2 - sh.shape[1], 0)
    return np.pad(sh, ((0, 0), (0, missing), (0, 0)))


def write_points(path: str | os.PathLike, cloud: PointCloud) -> None:
    """Write coloured points atomically: ``x y z``, normals if there are any, and colours.

    Colours are written twice: as bytes ``red green blue``, which viewers read, and as ``float_red
    float_green float_blue``, so that reading gives exactly the same colours. Faces are not written.

    Raises:
        ValueError: the shapes of the arrays don't agree.
        UserError: points or colours aren't finite, or the file can't be written.
    """
    if not (np.isfinite(cloud.points).all() and np.isfinite(cloud.colors).all()):
        raise UserError(f"{str(path)!r} isn't written: some of its points hold NaN or infinity")
    parts = [(MEANS, "float", cloud.points), (NORMALS, "float", cloud.normals)]
    parts += [(COLORS, "uchar", _as_bytes(cloud.colors)), (EXACT_COLORS, "float", cloud.colors)]
    parts = [
        (names, kind, _shaped(values, (len(cloud.points), 3), names[0]))
        for names, kind, values in parts
        if values is not None
    ]
    properties = [(name, kind) for names, kind, _ in parts for name in names]
    rows = np.empty(
        len(cloud.points), [(name, "<" + NUMBER_TYPES[kind]) for name, kind in properties]
    )
    for names, _, values in parts:
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    write_table(path, properties, rows)


def _as_float32(arrays: Gaussians) -> Gaussians:
    """Convert to float32 arrays; raise ValueError unless their shapes agree."""
    count, harmonics = (
        np.shape(arrays.sh)[:2] if np.ndim(arrays.sh) == 3 else (len(arrays.means), 1)
    )
    shapes = [(count, 3), (count, 4), (count, 3), (count,), (count, harmonics, 3)]
    return Gaussians(
        *(
            _shaped(values, shape, name)
            for values, shape, name in zip(arrays, shapes, arrays._fields, strict=True)
        )
    )


def _shaped(values: np.ndarray, shape: tuple[int, ...], name: str) -> np.ndarray:
    values = np.asarray(values)
    if values.shape != shape:
        raise ValueError(f"{name} has shape {values.shape}; {shape} was expected")
    return values if values.dtype == np.uint8 else values.astype(np.float32, copy=False)


def _as_bytes(colors: Float[np.ndarray, "P 3"]) -> np.ndarray:
    return np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)


# --------------------------------------------------------------------------------------------------
# reading


def read_gaussians(path: str | os.PathLike, *, allow_non_finite: bool = False) -> Gaussians:
    """Read Gaussians with any degree of spherical harmonics, in the file's axes.

    Args:
        path: the file.
        allow_non_finite: also return rows that are not :func:`usable`.

    Raises:
        UserError: there is no such file, it is no PLY of Gaussians, is damaged, or has rows that
            are not usable.
    """
    table = PlyTable.read(path)
    _require_gaussians(table)
    scales, opacities = _filtered(table, _read_log_scales(table), table["opacity"])
    arrays = Gaussians(table[MEANS], table[QUATS], scales, opacities, _read_sh(table))
    arrays = _without_zeros(arrays, table)
    if not allow_non_finite:
        table.require_valid(usable(arrays), "values")
    return arrays


def read_points(path: str | os.PathLike, *, allow_non_finite: bool = False) -> PointCloud:
    """Read coloured points.

    Points without colours become grey (0.5); Gaussians get the colour of the constant harmonic.

    Args:
        path: the file.
        allow_non_finite: also return rows with NaN or infinity.

    Raises:
        UserError: there is no such file, it is no PLY, has no positions, is damaged, or has values
            that aren't finite.
    """
    table = PlyTable.read(path)
    if missing := [name for name in MEANS if name not in table]:
        table.fail(f"the points lack {', '.join(missing)}.{_format_hint(table)}")
    normals = table[NORMALS] if all(name in table for name in NORMALS) else None
    cloud = PointCloud(points=table[MEANS], colors=_read_colors(table), normals=normals)
    if not allow_non_finite:
        table.require_valid(np.isfinite(cloud.points).all(axis=1), "positions")
        table.require_valid(np.isfinite(cloud.colors).all(axis=1), "colours")
    return cloud


def is_gaussian_ply(path: str | os.PathLike) -> bool:
    """Return whether the file is a PLY whose vertices have the properties of Gaussians."""
    try:
        with open(path, "rb") as file:
            header = read_header(file, str(path))
    except (OSError, UserError):
        return False
    names = {
        entry.name
        for element in header.elements
        if element.name == "vertex"
        for entry in element.properties
    }
    return not _lacking(names)


def _lacking(names: Collection[str]) -> list[str]:
    """Return the properties without which vertices with these ``names`` are no Gaussians."""
    colors = SH_CONSTANT if set(names) >= {*COLORS, "opacity"} else ()
    return [name for name in GAUSSIAN if name not in {*names, *LOG_SCALES[2:], *colors}]


def _require_gaussians(table: PlyTable) -> None:
    """Raise UserError if a property of Gaussians is missing; warn about unknown ones."""
    if missing := _lacking(table.names):
        table.fail(f"the Gaussians lack {', '.join(missing)}.{_format_hint(table)}")
    known = {*GAUSSIAN, *NORMALS, *COLORS, FILTER}
    unknown = [n for n in table.names if n not in known and not n.startswith("f_rest_")]
    if unknown:
        more = f" and {len(unknown) - 5} more" if len(unknown) > 5 else ""
        names = ", ".join(unknown[:5])
        logger.warning("%s: unknown properties are left out: %s%s", table.path, names, more)


def _read_log_scales(table: PlyTable) -> Float[np.ndarray, "N 3"]:
    """Read the logarithms of the scales; the third one of 2D Gaussians is ``FLAT_LOG_SCALE``."""
    names = [name for name in LOG_SCALES if name in table]
    scales = table[tuple(names)]
    if scales.shape[1] == 3 and not (len(scales) and (scales[:, 2] == -np.inf).all()):
        return scales
    logger.warning("%s: 2D Gaussians, without a third scale: read as flat ones", table.path)
    return np.pad(scales[:, :2], ((0, 0), (0, 1)), constant_values=FLAT_LOG_SCALE)


def _filtered(
    table: PlyTable, log_scales: Float[np.ndarray, "N 3"], logits: Float[np.ndarray, " N"]
) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Apply Mip-Splatting's 3D filter: the variances grow by its square, and opacities shrink by
    the ratio of the volumes.
    """
    if FILTER not in table:
        return log_scales, logits
    logger.warning("%s: its 3D filter is applied to scales and opacities", table.path)
    with np.errstate(divide="ignore", invalid="ignore"):  # filters that are 0 or NaN
        filters = np.log(table[FILTER].astype(np.float64))[:, None]
        larger = np.logaddexp(2 * log_scales, 2 * filters) / 2
        ratios = np.exp((log_scales - larger).sum(axis=1))
    opacities = packing.opacities(logits) * ratios
    return larger.astype(np.float32), packing.logits(opacities, packing.FLOAT_OPACITY_MARGIN)


def _without_zeros(arrays: Gaussians, table: PlyTable) -> Gaussians:
    """Leave out rows in which everything is zero, the quaternion too: buffers that a program has
    not filled, which would be Gaussians of size 1 at the origin.
    """
    empty = (arrays.quats == 0).all(axis=1) & (arrays.means == 0).all(axis=1)
    empty &= (arrays.log_scales == 0).all(axis=1) & (arrays.logit_opacities == 0)
    empty &= (arrays.sh[:, 0] == 0).all(axis=1)
    if not empty.any():
        return arrays
    logger.warning(
        "%s: %d of %d rows hold nothing but zeros: left out", table.path, empty.sum(), len(empty)
    )
    return arrays.rows(~empty)


def _format_hint(table: PlyTable) -> str:
    """Return a hint for the message if the properties are those of another kind of PLY."""
    if COMPRESSED in table:
        return (
            " It is a compressed PLY: convert it by `python -m threestudio_gaussiandreamer.convert "
            "in.compressed.ply out.ply`."
        )
    if set(MEANS) <= set(table.names) and not {*SH_CONSTANT, "opacity"} & set(table.names):
        return " It holds plain points: read it as a point cloud."
    return ""


def _read_sh(table: PlyTable) -> Float[np.ndarray, "N K 3"]:
    """Read the harmonics; ``f_rest`` may be missing."""
    count = sum(name.startswith("f_rest_") for name in table.names)
    rest_names = tuple(f"f_rest_{i}" for i in range(count))
    if any(name not in table for name in rest_names):
        table.fail(
            f"{count} properties f_rest_* were expected to be numbered f_rest_0 to "
            f"f_rest_{count - 1}."
        )
    harmonics = count // 3 + 1
    if count % 3 or round(harmonics**0.5) ** 2 != harmonics:
        table.fail(
            f"{count} properties f_rest_* fit no degree of spherical harmonics: 0, 9, 24 or 45 "
            "were expected."
        )
    if set(SH_CONSTANT) <= set(table.names):
        constant = table[SH_CONSTANT][:, None]
    else:
        constant = rgb_to_sh0(_read_colors(table))[:, None].astype(np.float32)
    if not count:
        return constant
    rest = table[rest_names].reshape(len(constant), 3, harmonics - 1).transpose(0, 2, 1)
    return np.concatenate([constant, rest], axis=1)


def _read_colors(table: PlyTable) -> Float[np.ndarray, "N 3"]:
    """Read colours in [0, 1] from the first of the known properties."""
    for names in (
        EXACT_COLORS,
        COLORS,
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
    ):
        if all(name in table for name in names):
            return unit_colors(table[names], table.stored_type(names[0]), table.path)
    if all(name in table for name in SH_CONSTANT):
        return sh0_colors(table[SH_CONSTANT])
    logger.warning("%s has no colours: grey is used", table.path)
    return np.full((table[MEANS].shape[0], 3), 0.5, np.float32)


def unit_colors(
    colors: Float[np.ndarray, "N 3"], stored_type: np.dtype, path: str | os.PathLike
) -> Float[np.ndarray, "N 3"]:
    """Convert colours stored as integers of 8 or 16 bits, or as numbers up to 1, to [0, 1].

    Args:
        stored_type: an integer type of 1 or 2 bytes says the range; of others the values do.
        path: the file, for the message.

    Raises:
        UserError: the values fit none of these ranges.
    """
    integer = np.issubdtype(stored_type, np.integer)
    finite = colors[np.isfinite(colors)]
    low, high = (finite.min(), finite.max()) if finite.size else (0.0, 0.0)
    if integer and stored_type.itemsize < 4:
        full = np.iinfo(stored_type).max
    elif high <= 255 and (integer or high > MAX_UNIT):
        full = 255  # floats well above 1 are bytes that were stored as floats, as in text files
    elif MAX_UNIT < high <= 65535 and (finite == np.rint(finite)).all():
        full = 65535
    else:
        full = 1
    if low < MIN_UNIT * full or high > MAX_UNIT * full:
        raise UserError(
            f"{str(path)!r}: its colours range from {low:g} to {high:g}; integers from 0 to 255, "
            "or to 65535 where they have 16 bits, or numbers from 0 to 1 were expected"
        )
    return colors / np.float32(full)
