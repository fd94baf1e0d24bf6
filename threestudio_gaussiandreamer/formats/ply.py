"""PLY files of 3D Gaussians and of coloured points.

Gaussians are written in the usual layout of 3D Gaussian splatting (little-endian float32):
``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``, where ``f_dc``/``f_rest`` are
spherical harmonics (``f_rest`` channel by channel), ``opacity`` is a logit, ``scale`` a logarithm
and ``rot`` a quaternion wxyz. When reading, ``f_rest`` may be missing; so may ``scale_2``, of 2D
Gaussians, and ``f_dc`` where ``red green blue`` are there, as nerfstudio's exporter writes. The
3D filter of Mip-Splatting, ``filter_3D``, is applied; rows of nothing but zeros are left out.

Tables of vertices are read as other programs write them: text or binary of either byte order,
properties in any order and of any number type, unknown properties and elements. No more is
allocated than the file's size accounts for, whatever count the header states."""

import logging
import os
import re
import struct
import warnings
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn, Optional

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import UserError
from ..core.files import atomic_file, existing_file
from ..gaussians.gaussians import Gaussians, finite, usable
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import rgb_to_sh0, sh0_colors
from . import packing

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
NUMBER_TYPES = {
    "char": "i1",
    "uchar": "u1",
    "short": "i2",
    "ushort": "u2",
    "int": "i4",
    "uint": "u4",
    "float": "f4",
    "double": "f8",
    "int8": "i1",
    "uint8": "u1",
    "int16": "i2",
    "uint16": "u2",
    "int32": "i4",
    "uint32": "u4",
    "float32": "f4",
    "float64": "f8",
}
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_BYTES = 1 << 20
PREFIX = re.compile("^(scalar_)?(scal_)?")
"""What CloudCompare and 3dgsconverter put before the names of properties."""


class Property(NamedTuple):
    """A property line of the header."""

    name: str
    type: str
    """NumPy's type code of the values, without byte order."""
    count_type: Optional[str] = None
    """NumPy's type code of a list's length; None where the property is no list."""


class Element(NamedTuple):
    """An element of the header: ``count`` rows of these properties."""

    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        return any(entry.count_type for entry in self.properties)

    def row_type(self, order: str) -> np.dtype:
        """Return the packed layout of a row, which must have no lists."""
        return np.dtype([(entry.name, order + entry.type) for entry in self.properties])


class Header(NamedTuple):
    """The header: a key of ``BYTE_ORDERS`` and the elements in their order."""

    encoding: str
    elements: list[Element]


class PlyTable:
    """The vertices of a file, one column per property."""

    def __init__(self, path: Path, vertices: Element, columns: dict[str, np.ndarray]):
        self.path, self._columns, self._count = path, columns, vertices.count
        self._types = {entry.name: np.dtype(entry.type) for entry in vertices.properties}

    @classmethod
    def read(cls, path: str | os.PathLike) -> "PlyTable":
        """Read the vertices of a file.

        Raises:
            UserError: no such file, not a PLY, without vertices, or damaged.
        """
        path = existing_file(path, "PLY file")
        try:
            with open(path, "rb") as file:
                header = read_header(file, str(path))
                vertices = _seek_vertices(file, header, str(path))
                columns = _read_rows(file, vertices, header.encoding, str(path))
                _report_what_follows(file, header, vertices, path)
                return cls(path, vertices, columns)
        except OSError as error:
            raise UserError(f"cannot read {str(path)!r}: {error.strerror or error}.") from error

    @property
    def names(self) -> list[str]:
        return list(self._columns)

    def __contains__(self, name: str) -> bool:
        return name in self._columns

    def __getitem__(self, names: str | tuple[str, ...]) -> Float[np.ndarray, "..."]:
        """Return one column (N,), or several (N, C), as float32."""
        with np.errstate(
            over="ignore"
        ):  # a double too large becomes infinite, which the check of values reports
            if isinstance(names, str):
                return self._columns[names].astype(np.float32)
            return np.stack([self._columns[name].astype(np.float32) for name in names], axis=1)

    def doubles(self, names: tuple[str, ...]) -> Float[np.ndarray, "N C"]:
        """Return several columns as float64, which holds every stored number exactly."""
        return np.stack([self._columns[name].astype(np.float64) for name in names], axis=1)

    def stored_type(self, name: str) -> np.dtype:
        """Return the number type that the header states."""
        return self._types[name]

    def fail(self, problem: str) -> NoReturn:
        """Raise UserError about this file."""
        _fail(str(self.path), problem)

    def require_valid(self, valid: Bool[np.ndarray, " N"], what: str) -> None:
        """Raise UserError unless every vertex is valid; ``what`` names the values."""
        if not valid.all():
            bad = self._count - valid.sum()
            self.fail(
                f"the {what} of {bad} of {self._count} vertices are NaN or infinite, first in "
                f"vertex {valid.argmin()}."
            )


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


# --------------------------------------------------------------------------------------------------
# tables


def write_table(
    path: str | os.PathLike,
    properties: list[tuple[str, str]],
    rows: np.ndarray,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary file atomically.

    Args:
        properties: name and PLY type of each column.
        rows: a packed little-endian record array, or (N, P) float32 where all types are float.
        comments: ASCII lines for the header.

    Raises:
        UserError: the file can't be written.
    """
    with atomic_file(path) as file:
        file.write(header_bytes(properties, len(rows), comments))
        little_endian = rows if rows.dtype.names else rows.astype("<f4", copy=False)
        file.write(np.ascontiguousarray(little_endian).data if len(rows) else b"")


def header_bytes(properties: list[tuple[str, str]], count: int, comments: Sequence[str]) -> bytes:
    """Return the header of a binary file with ``count`` vertices."""
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {count}",
    ]
    lines += [f"property {kind} {name}" for name, kind in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _fail(path: str, problem: str) -> NoReturn:
    raise UserError(f"PLY file {path!r}: {problem}")


def read_header(file: BinaryIO, path: str) -> Header:
    """Parse up to ``end_header``; the file is then at the first byte of the data."""
    if file.readline(16).rstrip() != b"ply":
        _fail(path, "this is not a PLY file: its first line is not 'ply'.")
    encoding, elements, line = None, [], b""
    while True:
        line = file.readline(MAX_HEADER_BYTES)
        if not line.endswith(b"\n") or file.tell() > MAX_HEADER_BYTES:
            _fail(path, "the header has no end: a line 'end_header' was expected.")
        words = line.decode("latin-1").split()
        if words == ["end_header"]:
            break
        if words[:1] == ["format"]:
            if encoding is not None:
                _fail(path, "the header states two formats.")
            encoding = words[1] if len(words) > 1 else ""
        elif words[:1] == ["element"]:
            elements.append(_parse_element(words, path))
        elif words[:1] == ["property"]:
            _add_property(words, elements, path)
        elif words and words[0] not in ("comment", "obj_info"):
            _fail(path, f"the header has an unknown line {' '.join(words)[:80]!r}.")
    if encoding not in BYTE_ORDERS:
        _fail(path, f"format {encoding!r} is unknown: {', '.join(BYTE_ORDERS)} were expected.")
    if sum(element.name == "vertex" for element in elements) > 1:
        _fail(path, "it has two elements of vertices.")
    for element in elements:
        if len({entry.name for entry in element.properties}) < len(element.properties):
            _fail(path, f"element {element.name!r} has two properties of the same name.")
    return Header(encoding, elements)


def _parse_element(words: list[str], path: str) -> Element:
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit() and len(words[2]) < 20):
        _fail(path, f"the header line {' '.join(words)[:80]!r} is not 'element NAME COUNT'.")
    return Element(words[1], int(words[2]), [])


def _add_property(words: list[str], elements: list[Element], path: str) -> None:
    is_list = words[1:2] == ["list"]
    types, name = words[2 if is_list else 1 : -1], PREFIX.sub("", words[-1])
    if (
        len(types) != (2 if is_list else 1)
        or any(kind not in NUMBER_TYPES for kind in types)
        or not elements
    ):
        _fail(
            path,
            f"the header line {' '.join(words)[:80]!r} is not a property of an element with a "
            "known number type.",
        )
    if name in [entry.name for entry in elements[-1].properties]:
        name = words[-1]
    codes = [NUMBER_TYPES[kind] for kind in types]
    elements[-1].properties.append(Property(name, codes[-1], codes[0] if is_list else None))


def _seek_vertices(file: BinaryIO, header: Header, path: str) -> Element:
    """Skip the elements before the vertices; return the vertices' element."""
    for element in header.elements:
        if element.name == "vertex":
            if element.has_lists:
                _fail(path, "a list among the properties of the vertices is not supported.")
            return element
        _skip(file, element, header.encoding, path)
    _fail(
        path,
        "there are no vertices: its elements are "
        f"{', '.join(element.name for element in header.elements)[:200] or 'none'}.",
    )


def _skip(file: BinaryIO, element: Element, encoding: str, path: str) -> None:
    remaining = _remaining(file)
    if element.count > remaining and element.properties:  # each row takes at least one byte
        _fail(
            path,
            f"{element.count} rows of {element.name!r} are announced, but {remaining} bytes "
            "follow: the file is truncated.",
        )
    if encoding == "ascii":
        _skip_lines(file, element, path)
    elif element.has_lists:
        _skip_lists(file, element, BYTE_ORDERS[encoding], path)
    else:
        file.seek(element.count * element.row_type("<").itemsize, os.SEEK_CUR)


def _skip_lines(file: BinaryIO, element: Element, path: str) -> None:
    """Skip the lines of an element, and blank ones between them.

    Each line must have as many numbers as the header states; otherwise the position of the first
    vertex would be wrong.
    """
    count = element.count if element.properties else 0
    while count and (line := file.readline()):
        words = line.split()
        if words and not _is_row(words, element):
            _fail(
                path,
                f"a line of {element.name!r} holds other numbers than its properties: "
                f"{line[:80].decode('latin-1')!r}.",
            )
        count -= bool(words)


def _is_row(words: list[bytes], element: Element) -> bool:
    try:
        numbers, at = [float(word) for word in words], 0
        for entry in element.properties:
            at += 1 + int(numbers[at]) if entry.count_type else 1
        return at == len(numbers)
    except (ValueError, IndexError, OverflowError):
        return False


def _skip_lists(file: BinaryIO, element: Element, order: str, path: str) -> None:
    """Skip binary rows with lists, each of which states its length."""
    start, data = file.tell(), file.read()
    try:
        size = _size_of_lists(data, element, order)
    except (
        struct.error,
        ValueError,
        OverflowError,
    ):  # OverflowError and ValueError: int() of infinity and NaN
        size = len(data) + 1
    if size > len(data):
        _fail(
            path,
            f"a list in {element.name!r} is longer than the file: it is truncated or damaged.",
        )
    file.seek(start + size)


def _size_of_lists(data: bytes, element: Element, order: str) -> int:
    """Return how many bytes the rows of an element take.

    Raises:
        struct.error, ValueError, OverflowError: the data end before a length, or a length is
            negative, NaN or infinite.
    """
    kinds = [(entry.count_type, np.dtype(entry.type).itemsize) for entry in element.properties]
    readers = [
        (kind and struct.Struct((order or "=") + np.dtype(kind).char), size) for kind, size in kinds
    ]
    at = 0
    for _ in range(element.count):
        for length, size in readers:
            if length:
                size *= int(length.unpack_from(data, at)[0])
                if size < 0:
                    raise ValueError("a negative length")
                at += length.size
            at += size
    return at


def _remaining(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size - file.tell()


def _read_rows(
    file: BinaryIO, vertices: Element, encoding: str, path: str
) -> dict[str, np.ndarray]:
    """Read the columns of the vertices."""
    if not vertices.properties:
        return {}
    if encoding == "ascii":
        return _read_text_rows(file, vertices, path)
    row_type = vertices.row_type(BYTE_ORDERS[encoding])
    size = vertices.count * row_type.itemsize
    _require_room(file, vertices, size, path)
    rows = np.frombuffer(file.read(size), row_type) if size else np.empty(0, row_type)
    return {name: rows[name] for name in row_type.names}


def _read_text_rows(file: BinaryIO, vertices: Element, path: str) -> dict[str, np.ndarray]:
    """Read one vertex per line, also integers as float64, so that a NaN among them is kept."""
    width = len(vertices.properties)
    _require_room(
        file, vertices, max(vertices.count * 2 * width - 1, 0), path
    )  # at least a digit and a separator per number
    rows = _parse_text(file, vertices.count, path) if vertices.count else np.empty((0, width))
    if rows.shape != (vertices.count, width):
        _fail(
            path,
            f"{vertices.count} vertices of {width} numbers are announced, but {rows.shape[0]} "
            f"of {rows.shape[1]} are there.",
        )
    for entry, values in zip(vertices.properties, rows.T, strict=True):
        limits = None if entry.type[0] == "f" else np.iinfo(entry.type)
        if limits and ((values < limits.min) | (values > limits.max)).any():
            _fail(
                path, f"{entry.name} is beyond the range of its type, {limits.min} to {limits.max}."
            )
    return {entry.name: column for entry, column in zip(vertices.properties, rows.T, strict=True)}


def _parse_text(file: BinaryIO, count: int, path: str) -> Float[np.ndarray, "N C"]:
    try:
        with warnings.catch_warnings():  # NumPy warns about missing rows, which the caller reports
            warnings.simplefilter("ignore", UserWarning)
            return np.loadtxt(
                file, np.float64, comments=None, max_rows=count, ndmin=2, encoding="latin-1"
            )
    except ValueError as error:
        _fail(path, f"a vertex is not readable: {error}.")


def _report_what_follows(file: BinaryIO, header: Header, vertices: Element, path: Path) -> None:
    """Warn if data follow the last vertex, since the count in the header may be wrong."""
    if header.elements[-1] is vertices and (rest := _remaining(file)) and file.read(4096).strip():
        logger.warning(
            "PLY file %r: %d bytes follow the %d vertices that its header announces",
            str(path),
            rest,
            vertices.count,
        )


def _require_room(file: BinaryIO, vertices: Element, size: int, path: str) -> None:
    if size > (remaining := _remaining(file)):
        _fail(
            path,
            f"{vertices.count} vertices need {size} bytes, but {remaining} follow the header: "
            "it is truncated or damaged.",
        )


# ---- faces ---------------------------------------------------------------------------------------


class Lists(NamedTuple):
    """A property of all faces: their numbers or lists, one after the other."""

    lengths: Int[np.ndarray, " F"]
    values: Float[np.ndarray, " V"]


def read_faces(path: str | os.PathLike) -> dict[str, Lists]:
    """Read the properties of the faces, by name, of a file whose vertices :class:`PlyTable` has
    read; empty where there are no faces.

    Raises:
        UserError: they are damaged or truncated.
    """
    with open(path, "rb") as file:
        header = read_header(file, str(path))
        for element in header.elements:
            if element.name == "face":
                try:
                    return _lists(_numbers(file.read(), element, header.encoding), element)
                except (ValueError, IndexError, OverflowError, struct.error) as error:
                    _fail(str(path), f"its faces are truncated or damaged ({error}).")
            if element.name == "vertex" and header.encoding == "ascii":  # checked before
                count = element.count if element.properties else 0
                while count and (line := file.readline()):
                    count -= bool(line.strip())
            else:
                _skip(file, element, header.encoding, str(path))
    return {}


def _numbers(data: bytes, element: Element, encoding: str) -> Float[np.ndarray, " T"]:
    """Return all numbers of an element, those before its lists included, and what follows it."""
    if element.count > len(data):
        raise ValueError(f"{element.count} are announced")
    if encoding == "ascii":
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # of text after the numbers
            return np.fromstring(data, np.float64, sep=" ")
    order = BYTE_ORDERS[encoding]
    kinds = [
        (entry.count_type and np.dtype(order + entry.count_type), np.dtype(order + entry.type))
        for entry in element.properties
    ]
    rows, at = [], 0
    while len(rows) < element.count:
        fields, row = [], at
        for length, kind in kinds:
            count = 1
            if length:
                count = int(np.frombuffer(data, length, 1, row)[0])
                fields.append((f"length {len(fields)}", length))
                row += length.itemsize
            fields.append((f"value {len(fields)}", kind, (count,)))
            row += count * kind.itemsize
        layout = np.dtype(fields)
        if not rows and element.count * layout.itemsize <= len(data):  # are all as the first?
            same = np.frombuffer(data, layout, element.count)
            lengths = [name for name in layout.names if name.startswith("length")]
            if all((same[name] == same[name][0]).all() for name in lengths):
                return _flat(same)
        rows.append(_flat(np.frombuffer(data, layout, 1, at)))
        at = row
    return np.concatenate([*rows, np.empty(0)])


def _flat(rows: np.ndarray) -> Float[np.ndarray, " T"]:
    columns = [rows[name].reshape(len(rows), -1) for name in rows.dtype.names]
    return np.concatenate(columns, axis=1, dtype=np.float64).ravel()


def _lists(numbers: Float[np.ndarray, " T"], element: Element) -> dict[str, Lists]:
    """Divide the numbers of an element into its properties."""
    count, at, row, alike = element.count, 0, 0, True
    ends = np.zeros((count, len(element.properties)), np.int64)
    lengths = np.ones_like(ends)
    while row < count:
        first = at
        for column, entry in enumerate(element.properties):
            if entry.count_type:
                lengths[row, column], at = int(numbers[at]), at + 1
            if lengths[row, column] < 0:
                raise ValueError("a list of negative length")
            at += lengths[row, column]
            ends[row, column] = at
        row += 1
        if row == 1:  # are all as the first?
            alike = count * (at - first) <= len(numbers)
            table = numbers[: count * (at - first)].reshape(count, -1) if alike else numbers
            starts = ends[0] - lengths[0]
            for column, entry in enumerate(element.properties):
                if entry.count_type and alike:
                    alike = (table[:, starts[column] - 1] == lengths[0, column]).all()
            if alike:
                lengths[:] = lengths[0]
                ends[:] = ends[0] + (at - first) * np.arange(count)[:, None]
                break
    if count and ends[-1].max(initial=0) > len(numbers):
        raise ValueError("the last ones are missing")
    return {
        entry.name: Lists(lengths[:, column], numbers[_ranges(ends[:, column], lengths[:, column])])
        for column, entry in enumerate(element.properties)
    }


def _ranges(ends: Int[np.ndarray, " F"], lengths: Int[np.ndarray, " F"]) -> np.ndarray:
    """Return the indices of all ranges that end before ``ends``, one after the other."""
    within = np.arange(lengths.sum()) - np.repeat(np.cumsum(lengths) - lengths, lengths)
    return within + np.repeat(ends - lengths, lengths)
