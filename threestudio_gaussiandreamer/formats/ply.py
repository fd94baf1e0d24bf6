"""PLY files of trained Gaussians and of coloured points, written and read with numpy alone.

Gaussians are written in the layout that every viewer of 3D Gaussian splatting reads (little-endian
float32): ``x y z nx ny nz f_dc_0..2 f_rest_0.. opacity scale_0..2 rot_0..3``, where
``f_dc``/``f_rest`` are spherical harmonics (``f_rest`` channel by channel), ``opacity`` is a logit,
``scale`` a logarithm and ``rot`` a quaternion wxyz.

The reader takes what other programs write: text or binary of either byte order, properties in any
order and of any number type, unknown properties and elements, no ``f_rest``. It believes no count
that the file's size can't hold."""

import logging
import os
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple, NoReturn, Optional

import numpy as np
from jaxtyping import Bool, Float

from ..core.errors import UserError
from ..core.files import atomic_file, existing_file
from ..gaussians.gaussians import Gaussians, usable
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import sh0_colors

logger = logging.getLogger(__name__)

NUMBER_TYPES = {
    "char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2", "int": "i4", "uint": "u4",
    "float": "f4", "double": "f8", "int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2",
    "int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8",
}  # fmt: skip
BYTE_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
MAX_HEADER_BYTES = 1 << 20

MEANS = ("x", "y", "z")
NORMALS = ("nx", "ny", "nz")
SH_CONSTANT = ("f_dc_0", "f_dc_1", "f_dc_2")
LOG_SCALES = ("scale_0", "scale_1", "scale_2")
QUATS = ("rot_0", "rot_1", "rot_2", "rot_3")
GAUSSIAN = (*MEANS, *SH_CONSTANT, "opacity", *LOG_SCALES, *QUATS)
COLORS = ("red", "green", "blue")
EXACT_COLORS = ("float_red", "float_green", "float_blue")


class _Property(NamedTuple):
    name: str
    type: str
    """numpy's code of the values, without byte order."""
    count_type: Optional[str] = None
    """Of a list: numpy's code of its length."""


class _Element(NamedTuple):
    name: str
    count: int
    properties: list[_Property]

    @property
    def has_lists(self) -> bool:
        return any(entry.count_type for entry in self.properties)

    def row_type(self, order: str) -> np.dtype:
        """The packed layout of one row without lists."""
        return np.dtype([(entry.name, order + entry.type) for entry in self.properties])


class _Header(NamedTuple):
    encoding: str
    elements: list[_Element]


# --------------------------------------------------------------------------------------------------
# writing


def write_gaussians(
    path: str | os.PathLike,
    *,
    means: Float[np.ndarray, "N 3"],
    sh: Float[np.ndarray, "N K 3"],
    logit_opacities: Float[np.ndarray, " N"],
    log_scales: Float[np.ndarray, "N 3"],
    quats: Float[np.ndarray, "N 4"],
    pad_sh_degree: Optional[int] = None,
    comments: Sequence[str] = (),
) -> None:
    """Write Gaussians as float32, whole or not at all.

    Args:
        path: the file; its folder must exist.
        means, sh, logit_opacities, log_scales, quats: as in :class:`Gaussians`; anything numpy
          takes as an array.
        pad_sh_degree: append zero harmonics up to this degree, for viewers that insist on degree 3.
        comments: ASCII lines for the header.

    Raises:
        ValueError: arrays whose shapes don't agree.
        UserError: the file can't be written.
    """
    arrays = _as_float32(Gaussians(means, quats, log_scales, logit_opacities, sh))
    sh = arrays.sh if pad_sh_degree is None else padded_sh(arrays.sh, pad_sh_degree)
    rest = (
        sh[:, 1:].transpose(0, 2, 1).reshape(len(sh), 3 * (sh.shape[1] - 1))
    )  # channel by channel
    columns = [
        arrays.means,
        np.zeros_like(arrays.means),
        sh[:, 0],
        rest,
        arrays.logit_opacities[:, None],
        arrays.log_scales,
        arrays.quats,
    ]
    _write(path, _gaussian_properties(sh.shape[1]), np.concatenate(columns, axis=1), comments)


def gaussians_size(count: int, harmonics: int, comments: Sequence[str] = ()) -> int:
    """The bytes of the file that :func:`write_gaussians` makes of ``count`` Gaussians with (degree
    + 1)^2 ``harmonics`` each.
    """
    properties = _gaussian_properties(harmonics)
    return len(_header_bytes(properties, count, comments)) + 4 * len(properties) * count


def _gaussian_properties(harmonics: int) -> list[tuple[str, str]]:
    rest = (f"f_rest_{i}" for i in range(3 * (harmonics - 1)))
    return [
        (name, "float")
        for name in (*MEANS, *NORMALS, *SH_CONSTANT, *rest, "opacity", *LOG_SCALES, *QUATS)
    ]


def read_comments(path: str | os.PathLike) -> list[str]:
    """The comments in the header of a PLY file; none where it is no PLY file."""
    with open(path, "rb") as file:
        head = file.read(MAX_HEADER_BYTES).partition(b"end_header")[0].decode("latin-1")
    lines = head.splitlines() if head.startswith("ply") else []
    return [line.removeprefix("comment ").strip() for line in lines if line.startswith("comment ")]


def padded_sh(sh: Float[np.ndarray, "N K 3"], degree: int) -> Float[np.ndarray, "N L 3"]:
    """``sh`` with zeros up to ``degree``; harmonics above it stay."""
    missing = max((degree + 1) ** 2 - sh.shape[1], 0)
    return np.pad(sh, ((0, 0), (0, missing), (0, 0)))


def write_points(path: str | os.PathLike, cloud: PointCloud) -> None:
    """Write coloured points, whole or not at all: ``x y z``, normals where known, ``red green
    blue`` as bytes.

    The bytes are what every viewer understands; ``float_red float_green float_blue`` after them
    hold the colours exactly, so that reading gives the same cloud bit for bit. Faces are not
    written.

    Raises:
        ValueError: arrays whose shapes don't agree.
        UserError: the file can't be written.
    """
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
    _write(path, properties, rows)


def _write(
    path: str | os.PathLike,
    properties: list[tuple[str, str]],
    rows: np.ndarray,
    comments: Sequence[str] = (),
) -> None:
    """Header and rows; ``rows`` is a packed little-endian record array, or (N, P) float32."""
    with atomic_file(path) as file:
        file.write(_header_bytes(properties, len(rows), comments))
        little_endian = rows if rows.dtype.names else rows.astype("<f4", copy=False)
        file.write(np.ascontiguousarray(little_endian).data if len(rows) else b"")


def _header_bytes(properties: list[tuple[str, str]], count: int, comments: Sequence[str]) -> bytes:
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        *(f"comment {comment}" for comment in comments),
        f"element vertex {count}",
    ]
    lines += [f"property {kind} {name}" for name, kind in properties]
    return ("\n".join([*lines, "end_header"]) + "\n").encode("ascii")


def _as_float32(arrays: Gaussians) -> Gaussians:
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
    """Read trained Gaussians, of any degree of spherical harmonics.

    Args:
        path: the file.
        allow_non_finite: leave rows that are not :func:`usable` to the caller.

    Raises:
        UserError: no such file, not a PLY, not of Gaussians, damaged, or with values that are not
            usable.
    """
    table = _Table.read(path)
    if missing := [name for name in GAUSSIAN if name not in table]:
        hint = (
            " It holds plain points: read it as a point cloud."
            if not set(SH_CONSTANT) & set(table.names)
            else ""
        )
        table.fail(f"the Gaussians lack {', '.join(missing)}.{hint}")
    known = {*GAUSSIAN, *NORMALS, *COLORS}
    if unknown := [
        name for name in table.names if name not in known and not name.startswith("f_rest_")
    ]:
        more = f" and {len(unknown) - 5} more" if len(unknown) > 5 else ""
        logger.warning("%s: not known here, and left out: %s%s", path, ", ".join(unknown[:5]), more)
    arrays = Gaussians(
        table[MEANS], table[QUATS], table[LOG_SCALES], table["opacity"], _read_sh(table)
    )
    if not allow_non_finite:
        table.require_valid(usable(arrays), "values")
    return arrays


def read_points(path: str | os.PathLike, *, allow_non_finite: bool = False) -> PointCloud:
    """Read coloured points; without colours they are grey (0.5), those of Gaussians come from the
    constant harmonic.

    Args:
        path: the file.
        allow_non_finite: leave rows with NaN or infinity to the caller.

    Raises:
        UserError: no such file, not a PLY, without positions, damaged, or with values that are not
            finite.
    """
    table = _Table.read(path)
    if missing := [name for name in MEANS if name not in table]:
        table.fail(f"the points lack {', '.join(missing)}.")
    normals = table[NORMALS] if all(name in table for name in NORMALS) else None
    cloud = PointCloud(points=table[MEANS], colors=_read_colors(table), normals=normals)
    if not allow_non_finite:
        table.require_valid(np.isfinite(cloud.points).all(axis=1), "positions")
        table.require_valid(np.isfinite(cloud.colors).all(axis=1), "colours")
    return cloud


def is_gaussian_ply(path: str | os.PathLike) -> bool:
    """Whether the file is a PLY whose vertices have the properties of Gaussians."""
    try:
        with open(path, "rb") as file:
            header = _read_header(file, str(path))
    except (OSError, UserError):
        return False
    names = {
        entry.name
        for element in header.elements
        if element.name == "vertex"
        for entry in element.properties
    }
    return names.issuperset(GAUSSIAN)


class _Table:
    """The vertices of a file: one column per property."""

    def __init__(self, path: Path, vertices: _Element, columns: dict[str, np.ndarray]):
        self.path, self._columns, self._count = path, columns, vertices.count
        self._types = {entry.name: np.dtype(entry.type) for entry in vertices.properties}

    @classmethod
    def read(cls, path: str | os.PathLike) -> "_Table":
        path = existing_file(path, "PLY file")
        try:
            with open(path, "rb") as file:
                header = _read_header(file, str(path))
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
        """One column (N,), or several (N, C), as float32."""
        with np.errstate(
            over="ignore"
        ):  # a double too large becomes infinite, which the check of values reports
            if isinstance(names, str):
                return self._columns[names].astype(np.float32)
            return np.stack([self._columns[name].astype(np.float32) for name in names], axis=1)

    def stored_type(self, name: str) -> np.dtype:
        """The number type that the header states, which says what the largest colour is."""
        return self._types[name]

    def fail(self, problem: str) -> NoReturn:
        _fail(str(self.path), problem)

    def require_valid(self, valid: Bool[np.ndarray, " N"], what: str) -> None:
        """Raise unless every vertex is valid."""
        if not valid.all():
            bad = self._count - valid.sum()
            self.fail(
                f"the {what} of {bad} of {self._count} vertices are NaN or infinite, first in "
                f"vertex {valid.argmin()}."
            )


def _read_sh(table: _Table) -> Float[np.ndarray, "N K 3"]:
    """The harmonics; ``f_rest`` may be missing."""
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
    constant = table[SH_CONSTANT][:, None]
    if not count:
        return constant
    rest = table[rest_names].reshape(len(constant), 3, harmonics - 1).transpose(0, 2, 1)
    return np.concatenate([constant, rest], axis=1)


def _read_colors(table: _Table) -> Float[np.ndarray, "N 3"]:
    """Colours in [0, 1] from the first of the known properties."""
    for names in (
        EXACT_COLORS,
        COLORS,
        ("diffuse_red", "diffuse_green", "diffuse_blue"),
        ("r", "g", "b"),
    ):
        if all(name in table for name in names):
            return unit_colors(table[names], table.stored_type(names[0]))
    if all(name in table for name in SH_CONSTANT):
        return sh0_colors(table[SH_CONSTANT])
    logger.info("%s has no colours: grey is used", table.path)
    return np.full((table[MEANS].shape[0], 3), 0.5, np.float32)


def unit_colors(
    colors: Float[np.ndarray, "N 3"], stored_type: np.dtype
) -> Float[np.ndarray, "N 3"]:
    """Colours stored as integers, or as floats up to 255, in [0, 1]."""
    if np.issubdtype(stored_type, np.integer):
        return colors / np.float32(np.iinfo(stored_type).max if stored_type.itemsize < 4 else 255)
    finite = colors[np.isfinite(colors)]
    # Floats beyond any rounding of 1 are bytes that a program or a text file keeps as floats.
    return colors / np.float32(255) if finite.size and 2 < finite.max() <= 255 else colors


def _fail(path: str, problem: str) -> NoReturn:
    raise UserError(f"PLY file {path!r}: {problem}")


def _read_header(file: BinaryIO, path: str) -> _Header:
    """Parse up to ``end_header``, leaving the file at the first byte of the data."""
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
    return _Header(encoding, elements)


def _parse_element(words: list[str], path: str) -> _Element:
    if len(words) != 3 or not (words[2].isascii() and words[2].isdigit() and len(words[2]) < 20):
        _fail(path, f"the header line {' '.join(words)[:80]!r} is not 'element NAME COUNT'.")
    return _Element(words[1], int(words[2]), [])


def _add_property(words: list[str], elements: list[_Element], path: str) -> None:
    is_list = words[1:2] == ["list"]
    types, name = words[2 if is_list else 1 : -1], words[-1]
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
    codes = [NUMBER_TYPES[kind] for kind in types]
    elements[-1].properties.append(_Property(name, codes[-1], codes[0] if is_list else None))


def _seek_vertices(file: BinaryIO, header: _Header, path: str) -> _Element:
    """Skip the elements that lie before the vertices."""
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


def _skip(file: BinaryIO, element: _Element, encoding: str, path: str) -> None:
    remaining = _remaining(file)
    if element.count > remaining and element.properties:  # each row has a byte at least
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


def _skip_lines(file: BinaryIO, element: _Element, path: str) -> None:
    """Skip the lines of an element but for blank ones; their numbers must be as many as announced,
    or the vertices begin elsewhere.
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


def _is_row(words: list[bytes], element: _Element) -> bool:
    try:
        numbers, at = [float(word) for word in words], 0
        for entry in element.properties:
            at += 1 + int(numbers[at]) if entry.count_type else 1
        return at == len(numbers)
    except (ValueError, IndexError, OverflowError):
        return False


def _skip_lists(file: BinaryIO, element: _Element, order: str, path: str) -> None:
    """Walk over rows whose length each list announces."""
    for _ in range(element.count):
        for entry in element.properties:
            length = 1
            if entry.count_type:
                count_type = np.dtype(order + entry.count_type)
                raw = file.read(count_type.itemsize)
                length = (
                    int(np.frombuffer(raw, count_type)[0])
                    if len(raw) == count_type.itemsize
                    else -1
                )
            size = length * np.dtype(entry.type).itemsize
            if not 0 <= size <= _remaining(file):
                _fail(
                    path,
                    f"a list in {element.name!r} is longer than the file: it is truncated or "
                    "damaged.",
                )
            file.seek(size, os.SEEK_CUR)


def _remaining(file: BinaryIO) -> int:
    return os.fstat(file.fileno()).st_size - file.tell()


def _read_rows(
    file: BinaryIO, vertices: _Element, encoding: str, path: str
) -> dict[str, np.ndarray]:
    """The columns of the vertices."""
    if not vertices.properties:
        return {}
    if encoding == "ascii":
        return _read_text_rows(file, vertices, path)
    row_type = vertices.row_type(BYTE_ORDERS[encoding])
    size = vertices.count * row_type.itemsize
    _require_room(file, vertices, size, path)
    rows = np.frombuffer(file.read(size), row_type) if size else np.empty(0, row_type)
    return {name: rows[name] for name in row_type.names}


def _read_text_rows(file: BinaryIO, vertices: _Element, path: str) -> dict[str, np.ndarray]:
    """One vertex per line; integers become floats too, so that a NaN among them is seen later."""
    width = len(vertices.properties)
    _require_room(
        file, vertices, max(vertices.count * 2 * width - 1, 0), path
    )  # a digit and a blank per number
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
        with warnings.catch_warnings():  # numpy warns of missing rows, which the caller reports
            warnings.simplefilter("ignore", UserWarning)
            return np.loadtxt(
                file, np.float64, comments=None, max_rows=count, ndmin=2, encoding="latin-1"
            )
    except ValueError as error:
        _fail(path, f"a vertex is not readable: {error}.")


def _report_what_follows(file: BinaryIO, header: _Header, vertices: _Element, path: Path) -> None:
    """Say when there is more than the header announces, since then its count may be wrong."""
    if header.elements[-1] is vertices and (rest := _remaining(file)) and file.read(4096).strip():
        logger.warning(
            "PLY file %r: %d bytes follow the %d vertices that its header announces",
            str(path),
            rest,
            vertices.count,
        )


def _require_room(file: BinaryIO, vertices: _Element, size: int, path: str) -> None:
    if size > (remaining := _remaining(file)):
        _fail(
            path,
            f"{vertices.count} vertices need {size} bytes, but {remaining} follow the header: "
            "it is truncated or damaged.",
        )
