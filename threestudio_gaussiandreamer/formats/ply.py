"""PLY files of 3D Gaussians and of coloured points.

Gaussians are written in the usual layout of 3D Gaussian splatting: spherical harmonics channel by
channel, logits of opacities, logarithms of scales, quaternions wxyz. When reading, ``f_rest`` may
be missing; so may ``scale_2``, of 2D Gaussians, and ``f_dc`` where ``red green blue`` are there.

Tables of vertices are read as other programs write them: text or binary of either byte order,
properties in any order and of any number type, unknown properties and elements. No more is
allocated than the file's size accounts for, whatever count the header states."""

import io
import itertools
import logging
import os
import re
from collections.abc import Collection, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, Optional

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..core.files import atomic_file
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import rgb_to_sh0, sh0_colors
from . import packing
from .reading import reading, require

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
MIN_UNIT, MAX_UNIT = -0.01, 2.0
"""Range of colours that are taken for numbers in [0, 1], which interpolation exceeds a little."""
NUMBER_TYPES = dict(
    pair.split(":")
    for pair in "char:i1 uchar:u1 short:i2 ushort:u2 int:i4 uint:u4 float:f4 double:f8 int8:i1 "
    "uint8:u1 int16:i2 uint16:u2 int32:i4 uint32:u4 float32:f4 float64:f8".split()
)
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_BYTES = 1 << 20
PREFIX = re.compile("^(scalar_)?(scal_)?")
"""What CloudCompare and 3dgsconverter put before the names of properties."""


class Property(NamedTuple):
    name: str
    type: str
    """NumPy's type code of the values, without byte order."""
    count_type: Optional[str] = None
    """That of a list's length; None where the property is no list."""


class Element(NamedTuple):
    name: str
    count: int
    properties: list[Property]

    @property
    def has_lists(self) -> bool:
        return any(entry.count_type for entry in self.properties)


class Header(NamedTuple):
    encoding: str = ""
    """A key of ``BYTE_ORDERS``."""
    elements: Sequence[Element] = ()
    comments: Sequence[str] = ()


class Lists(NamedTuple):
    """A property of all faces: their numbers or lists, one after the other."""

    lengths: Int[np.ndarray, " F"]
    values: Float[np.ndarray, " V"]


class PlyTable:
    """The vertices of a file, one column per property, and its faces if they are asked for."""

    def __init__(self, path: Path, faces: bool = False) -> None:
        with open(path, "rb") as file:
            header, data = read_header(file), file.read()
        names, at = [element.name for element in header.elements], 0
        said = ", ".join(names)[:200] or "none"
        said = f"one element of vertices without lists was expected; its elements are {said}"
        vertices = [element for element in header.elements if element.name == "vertex"]
        require(len(vertices) == 1 and not vertices[0].has_lists, said)
        if header.encoding == "ascii":
            data = _packed(data, header.elements)
        wanted = {"vertex", "face"} & {*names} if faces else {"vertex"}
        found: dict[str, dict[str, Lists]] = {}
        for element in header.elements:
            found[element.name], at = read_rows(data, at, element, header.encoding)
            if wanted <= found.keys() and header.encoding != "ascii":
                break
        if element is header.elements[-1] and data[at : at + 4096].strip():
            shifted = header.encoding == "ascii" and any(each.has_lists for each in header.elements)
            require(not shifted, "it has more numbers than its header announces")
            said = "PLY file %r: more data follows than the %d rows of %r that it announces"
            logger.warning(said, str(path), element.count, element.name)
        self.path, self.comments = path, header.comments
        self.columns = {name: column.values for name, column in found["vertex"].items()}
        self.faces = found.get("face", {})
        self.types = {entry.name: np.dtype(entry.type) for entry in vertices[0].properties}
        for name in (name for name, kind in self.types.items() if kind.kind != "f"):
            limits, column = np.iinfo(self.types[name]), self.columns[name]
            beyond = ((column < limits.min) | (column > limits.max)).any()
            require(not beyond, f"{name} is beyond the range of its type")

    def has(self, names: Collection[str]) -> bool:
        return all(name in self.columns for name in names)

    def __getitem__(self, names: str | tuple[str, ...]) -> Float[np.ndarray, "..."]:
        """Return one column (N,), or several (N, C), as float32; too large doubles are infinite."""
        with np.errstate(over="ignore"):
            if isinstance(names, str):
                return self.columns[names].astype(np.float32)
            return np.stack([self.columns[name].astype(np.float32) for name in names], axis=1)

    def doubles(self, names: tuple[str, ...]) -> Float[np.ndarray, "N C"]:
        """Return several columns as float64, which holds every stored number exactly."""
        return np.stack([self.columns[name].astype(np.float64) for name in names], axis=1)


def write_gaussians(
    path: str | os.PathLike, gaussians: Gaussians, comments: Sequence[str] = ()
) -> None:
    """Write Gaussians as float32, atomically, without those that can't be drawn.

    Args:
        path: the file; its folder must exist.
        comments: ASCII lines for the header.

    Raises:
        UserError: the file can't be written.
    """
    gaussians = finite(gaussians, str(path))
    names = gaussian_properties(gaussians.sh.shape[1])
    write_table(path, names, gaussian_columns(gaussians), comments)


def gaussian_properties(harmonics: int) -> list[tuple[str, str]]:
    """Return name and type of each column of Gaussians with (degree + 1)^2 ``harmonics``."""
    rest = (f"f_rest_{i}" for i in range(3 * (harmonics - 1)))
    names = (*MEANS, *NORMALS, *SH_CONSTANT, *rest, "opacity", *LOG_SCALES, *QUATS)
    return [(name, "float") for name in names]


def gaussian_columns(gaussians: Gaussians) -> Float[np.ndarray, "N P"]:
    """Return the values of the columns of :func:`gaussian_properties`; normals are zero."""
    count, harmonics = gaussians.sh.shape[:2]
    by_channel = gaussians.sh[:, 1:].transpose(0, 2, 1).reshape(count, 3 * (harmonics - 1))
    means, logits = gaussians.means, gaussians.logit_opacities[:, None]
    columns = [means, np.zeros_like(means), gaussians.sh[:, 0], by_channel, logits]
    return np.concatenate([*columns, gaussians.log_scales, gaussians.quats], axis=1)


def write_points(path: str | os.PathLike, cloud: PointCloud) -> None:
    """Write coloured points atomically: ``x y z``, normals if there are any, and colours.

    Colours are written twice: as bytes ``red green blue``, which viewers read, and as ``float_red
    float_green float_blue``, so that reading gives exactly the same colours. Faces are not written.

    Raises:
        UserError: points or colours aren't finite, or the file can't be written.
    """
    if not (np.isfinite(cloud.points).all() and np.isfinite(cloud.colors).all()):
        raise UserError(f"{str(path)!r} isn't written: some of its points hold NaN or infinity")
    colors = np.rint(np.clip(cloud.colors, 0.0, 1.0) * 255.0)
    parts = [(MEANS, "float", cloud.points), (NORMALS, "float", cloud.normals)]
    parts += [(COLORS, "uchar", colors), (EXACT_COLORS, "float", cloud.colors)]
    parts = [part for part in parts if part[2] is not None]
    properties = [(name, kind) for names, kind, _ in parts for name in names]
    layout = [(name, "<" + NUMBER_TYPES[kind]) for name, kind in properties]
    rows = np.empty(len(cloud.points), layout)
    for names, _, values in parts:
        for name, column in zip(names, values.T, strict=True):
            rows[name] = column
    write_table(path, properties, rows)


def read_gaussians(path: str | os.PathLike) -> Gaussians:
    """Read Gaussians with any degree of spherical harmonics, in the file's axes, also those with
    values that aren't finite; without rows of zeros, which would be Gaussians of size 1.

    Raises:
        UserError: there is no such file, it is no PLY of Gaussians, or it is damaged.
    """
    with reading(path, "PLY file") as file:
        table = PlyTable(file)
        missing = _lacking(table.columns)
        require(not missing, f"the Gaussians lack {', '.join(missing)}.{_format_hint(table)}")
        known = {*GAUSSIAN, *NORMALS, *COLORS, FILTER}
        unknown = [n for n in table.columns if n not in known and not n.startswith("f_rest_")]
        if unknown:
            more = f" and {len(unknown) - 5} more" if len(unknown) > 5 else ""
            names = ", ".join(unknown[:5])
            logger.warning("%s: unknown properties are left out: %s%s", file, names, more)
        arrays = Gaussians(table[MEANS], table[QUATS], *_read_sizes(table), _read_sh(table))
    parts = (*arrays[:4], arrays.sh[:, 0])
    filled = np.logical_or.reduce([p.any(axis=(*range(1, p.ndim),)) for p in parts])
    if filled.all():
        return arrays
    said = "%s: %d of %d rows hold nothing but zeros: left out"
    logger.warning(said, path, (~filled).sum(), len(filled))
    return arrays.rows(filled)


def read_points(path: str | os.PathLike) -> PointCloud:
    """Read coloured points, also those with values that aren't finite.

    Points without colours become grey (0.5); Gaussians get the colour of the constant harmonic.

    Raises:
        UserError: there is no such file, it is no PLY, has no positions, or is damaged.
    """
    with reading(path, "PLY file") as file:
        table = PlyTable(file)
        missing = [name for name in MEANS if name not in table.columns]
        require(not missing, f"the points lack {', '.join(missing)}.{_format_hint(table)}")
        normals = table[NORMALS] if table.has(NORMALS) else None
        return PointCloud(points=table[MEANS], colors=_read_colors(table), normals=normals)


def require_ply(path: Path) -> None:
    """Raise UserError unless a file begins with the header of a PLY."""
    with reading(path, "PLY file") as file, open(file, "rb") as opened:
        read_header(opened)


def is_gaussian_ply(path: str | os.PathLike) -> bool:
    """Return whether the file is a PLY whose vertices have the properties of Gaussians."""
    found = [element for element in header_of(path).elements if element.name == "vertex"]
    return bool(found) and not _lacking([entry.name for entry in found[0].properties])


def header_of(path: str | os.PathLike) -> Header:
    """Return the header of a PLY; an empty one if the file isn't one."""
    try:
        with open(path, "rb") as file:
            return read_header(file)
    except (OSError, ValueError):
        return Header()


def read_comments(path: str | os.PathLike) -> list[str]:
    """Return the comments in the header of a PLY file; empty if it isn't one."""
    return [*header_of(path).comments]


def _lacking(names: Collection[str]) -> list[str]:
    """Return the properties without which vertices with these ``names`` are no Gaussians."""
    colors = SH_CONSTANT if set(names) >= {*COLORS, "opacity"} else ()
    return [name for name in GAUSSIAN if name not in {*names, *LOG_SCALES[2:], *colors}]


def _read_sizes(table: PlyTable) -> tuple[Float[np.ndarray, "N 3"], Float[np.ndarray, " N"]]:
    """Read logarithms of scales and logits of opacities. By Mip-Splatting's 3D filter the variances
    grow by its square, and opacities shrink by the ratio of the volumes.
    """
    scales = table[tuple(name for name in LOG_SCALES if name in table.columns)]
    logits = table["opacity"]
    if scales.shape[1] < 3 or (len(scales) and (scales[:, 2] == -np.inf).all()):
        logger.warning("%s: 2D Gaussians, without a third scale: read as flat ones", table.path)
        scales = np.pad(scales[:, :2], ((0, 0), (0, 1)), constant_values=np.log(1e-6))
    if FILTER not in table.columns:
        return scales, logits
    logger.warning("%s: its 3D filter is applied to scales and opacities", table.path)
    filters = np.log(table[FILTER].astype(np.float64))[:, None]
    larger = np.logaddexp(2 * scales, 2 * filters) / 2
    opacities = packing.opacities(logits) * np.exp((scales - larger).sum(axis=1))
    return larger.astype(np.float32), packing.logits(opacities, packing.FLOAT_OPACITY_MARGIN)


def _format_hint(table: PlyTable) -> str:
    """Return the end of a message about a PLY whose properties are those of another kind."""
    if "packed_position" in table.columns:
        command = "python -m threestudio_gaussiandreamer.convert in.compressed.ply out.ply"
        return f" It is a compressed PLY: convert it by `{command}`."
    if table.has(MEANS) and not {*SH_CONSTANT, "opacity"} & set(table.columns):
        return " It holds plain points: read it as a point cloud."
    return ""


def _read_sh(table: PlyTable) -> Float[np.ndarray, "N K 3"]:
    """Read the harmonics; ``f_rest`` may be missing."""
    count = sum(name.startswith("f_rest_") for name in table.columns)
    rest_names = tuple(f"f_rest_{i}" for i in range(count))
    usual = count % 3 == 0 and round((count // 3 + 1) ** 0.5) ** 2 == count // 3 + 1
    said = f"{count} properties f_rest_* fit no degree of spherical harmonics: f_rest_0 to f_rest_"
    require(usual and table.has(rest_names), f"{said}8, _23 or _44 were expected")
    if table.has(SH_CONSTANT):
        constant = table[SH_CONSTANT][:, None]
    else:
        constant = rgb_to_sh0(_read_colors(table))[:, None].astype(np.float32)
    if not count:
        return constant
    rest = table[rest_names].reshape(len(constant), 3, count // 3).transpose(0, 2, 1)
    return np.concatenate([constant, rest], axis=1)


def _read_colors(table: PlyTable) -> Float[np.ndarray, "N 3"]:
    """Read colours in [0, 1] from the first of the known properties."""
    diffuse = ("diffuse_red", "diffuse_green", "diffuse_blue")
    for names in (EXACT_COLORS, COLORS, diffuse, ("r", "g", "b")):
        if table.has(names):
            return unit_colors(table[names], table.types[names[0]])
    if table.has(SH_CONSTANT):
        return sh0_colors(table[SH_CONSTANT])
    logger.warning("%s has no colours: grey is used", table.path)
    return np.full((table[MEANS].shape[0], 3), 0.5, np.float32)


def unit_colors(
    colors: Float[np.ndarray, "N 3"], stored_type: np.dtype
) -> Float[np.ndarray, "N 3"]:
    """Convert colours to [0, 1], of integers of 8 or 16 bits, or numbers up to 1. A ``stored_type``
    of 1 or 2 bytes says which, else the values do; Unreadable if they fit none of these ranges.
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
    said = f"its colours range from {low:g} to {high:g}; integers from 0 to 255, or to 65535 where "
    said += "they have 16 bits, or numbers from 0 to 1 were expected"
    require(low >= MIN_UNIT * full and high <= MAX_UNIT * full, said)
    return colors / np.float32(full)


def write_table(
    path: str | os.PathLike,
    properties: list[tuple[str, str]],
    rows: np.ndarray,
    comments: Sequence[str] = (),
) -> None:
    """Write a binary file atomically: ``rows`` of (N, P) floats, or packed little-endian records,
    whose columns have the names and PLY types of ``properties``.
    """
    with atomic_file(path) as file:
        file.write(header_bytes([("vertex", len(rows), properties)], comments))
        little_endian = rows if rows.dtype.names else rows.astype("<f4", copy=False)
        file.write(np.ascontiguousarray(little_endian).data if len(rows) else b"")


def header_bytes(
    elements: Sequence[tuple[str, int, Sequence[tuple[str, str]]]], comments: Sequence[str]
) -> bytes:
    """Return the header of a binary file: of each element name, count, and (name, type) pairs."""
    lines = ["ply", "format binary_little_endian 1.0", *(f"comment {line}" for line in comments)]
    for element, count, properties in elements:
        lines += [f"element {element} {count}"]
        lines += [f"property {kind} {name}" for name, kind in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def read_header(file: BinaryIO) -> Header:
    """Parse up to ``end_header``, after which the data begins; Unreadable if it is damaged."""
    first = file.readline(16).rstrip()
    require(first == b"ply", "this is not a PLY file: its first line is not 'ply'")
    encoding, elements, comments, words = None, [], [], []
    while words != ["end_header"]:
        line = file.readline(MAX_HEADER_BYTES)
        ended = line.endswith(b"\n") and file.tell() <= MAX_HEADER_BYTES
        require(ended, "the header has no end: a line 'end_header' was expected")
        words = line.decode("latin-1").split()
        kind = words[0] if words else "comment"
        if line.startswith(b"comment "):
            comments.append(line.decode("latin-1").removeprefix("comment ").strip())
        elif kind == "format" and encoding is None:
            encoding = words[1] if len(words) > 1 else ""
        elif kind == "element" and len(words) == 3 and re.fullmatch("[0-9]{1,19}", words[2]):
            elements.append(Element(words[1], int(words[2]), []))
        elif kind == "property" and elements:
            elements[-1].properties.append(_property(words, elements[-1]))
        else:
            known = kind in ("comment", "obj_info", "end_header")
            require(known, f"the header has an unknown line {' '.join(words)[:80]!r}")
    known = ", ".join(BYTE_ORDERS)
    require(encoding in BYTE_ORDERS, f"format {encoding!r} is unknown: {known} were expected")
    return Header(encoding, elements, comments)


def _property(words: list[str], element: Element) -> Property:
    is_list = words[1:2] == ["list"]
    types, name = words[2 if is_list else 1 : -1], PREFIX.sub("", words[-1])
    usual = len(types) == (2 if is_list else 1) and all(kind in NUMBER_TYPES for kind in types)
    said = f"the header line {' '.join(words)[:80]!r} is not a property with a known number type"
    require(usual, said)
    others = [entry.name for entry in element.properties]
    name = words[-1] if name in others else name
    require(name not in others, f"element {element.name!r} has two properties of the same name")
    codes = [NUMBER_TYPES[kind] for kind in types]
    return Property(name, codes[-1], codes[0] if is_list else None)


def _packed(text: bytes, elements: Sequence[Element]) -> bytes:
    """Return the numbers of a text as float64; before the first list, a line has to be a row."""
    plain = itertools.takewhile(lambda element: not element.has_lists, elements)
    filled = (itertools.repeat(element, element.count) for element in plain if element.properties)
    rows = itertools.chain.from_iterable(filled)

    def words(line: bytes) -> list[bytes]:
        found = line.split()
        if found and (element := next(rows, None)):
            width = len(element.properties)
            said = (
                f"a row of {element.name!r} has other than the {width} numbers that are announced"
            )
            require(len(found) == width, said)
        return found

    require(b"_" not in text, "it has other words than numbers")  # Python reads 1_0 as 10
    numbers = map(float, itertools.chain.from_iterable(map(words, io.BytesIO(text))))
    return np.fromiter(numbers, np.float64).tobytes()


def read_rows(
    data: bytes, at: int, element: Element, encoding: str
) -> tuple[dict[str, Lists], int]:
    """Read the properties of an element whose rows begin at the byte ``at``, as views of ``data``
    where all lists are as long as those of the first row; also return where the rows end. The
    numbers of a text are float64.
    """
    count, order, text = element.count, BYTE_ORDERS[encoding], encoding == "ascii"
    names = [entry.name for entry in element.properties]
    kinds = [
        [code and np.dtype("f8" if text else order + code) for code in (each.count_type, each.type)]
        for each in element.properties
    ]
    if not count or not names:
        return {name: Lists(np.zeros(0, np.int64), np.zeros(0)) for name in names}, at

    def row(at: int) -> tuple[list[tuple[int, int]], int]:
        """Return where each property begins and its length, and where the row ends."""
        found = []
        for of_length, kind in kinds:
            length = 1
            if of_length:
                length, at = int(np.frombuffer(data, of_length, 1, at)[0]), at + of_length.itemsize
                require(length >= 0, "it has a list of negative length")
            found.append((at, length))
            at += length * kind.itemsize
        return found, at

    least = count * sum((of_length or kind).itemsize for of_length, kind in kinds)
    said = f"it ends before the {count} rows of {element.name!r} that it announces: it is truncated"
    require(at + least <= len(data), said)
    first, end = row(at)
    lengths = [length for _, length in first]
    if at + count * (end - at) <= len(data):  # are all as the first?
        fields = [
            [(f"length {i}", of_length)] * bool(of_length) + [(str(i), kind, (length,))]
            for i, ((of_length, kind), length) in enumerate(zip(kinds, lengths, strict=True))
        ]
        rows = np.frombuffer(data, sum(fields, []), count, at)
        listed = [i for i, (of_length, _) in enumerate(kinds) if of_length]
        if all((rows[f"length {i}"] == lengths[i]).all() for i in listed):
            return {
                name: Lists(np.broadcast_to(length, count), rows[str(i)].reshape(-1))
                for i, (name, length) in enumerate(zip(names, lengths, strict=True))
            }, at + rows.nbytes
    found = []
    for _ in range(count):
        places, at = row(at)
        found.append(places)
    require(at <= len(data), "a list is longer than the file: it is truncated or damaged")
    columns = {}
    for name, (_, kind), places in zip(names, kinds, zip(*found, strict=True), strict=True):
        parts = [np.frombuffer(data, kind, n, start) for start, n in places if n]
        lengths = np.array([n for _, n in places])
        columns[name] = Lists(lengths, np.concatenate([np.zeros(0, kind), *parts]))
    return columns, at
