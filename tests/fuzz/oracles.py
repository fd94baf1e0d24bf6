"""Strict reference readers, written from the formats' specifications only.

Each takes a file's bytes and returns their content, or raises :class:`Illegal` if the file is
invalid. The package's readers must return the same content."""

import ast
import hashlib
import io
import json
import struct
import zipfile
import zlib
from typing import NamedTuple, Optional

import numpy as np

TYPES = {
    "char": "b",
    "uchar": "B",
    "short": "h",
    "ushort": "H",
    "int": "i",
    "uint": "I",
    "float": "f",
    "double": "d",
}
TYPES |= {
    "int8": "b",
    "uint8": "B",
    "int16": "h",
    "uint16": "H",
    "int32": "i",
    "uint32": "I",
    "float32": "f",
    "float64": "d",
}


class Illegal(Exception):
    """The bytes are not a valid file of this format."""


# ---- PLY -----------------------------------------------------------------------------------------


class PlyVertices(NamedTuple):
    """The first element called "vertex"."""

    columns: dict[str, np.ndarray]
    """float64 by the name of the property."""
    types: dict[str, str]
    count: int
    leftover: bool
    """Whether something other than blanks follows the last row that the header announces."""


class _Rows:
    """The unread rest of the body."""

    def __init__(self, encoding: str, body: bytes):
        self.order = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
        self.at, self.body = 0, body
        self.lines = (
            [line.split() for line in body.decode("latin-1").split("\n")] if not self.order else []
        )
        self.lines = [line for line in self.lines if line]

    def row(self, properties: list[tuple[str, str, str]]) -> list[float]:
        return self._binary(properties) if self.order else self._text(properties)

    def _binary(self, properties: list[tuple[str, str, str]]) -> list[float]:
        values = []
        for _, kind, count_kind in properties:
            length = self._number(count_kind) if count_kind else 1
            if length != int(length) or not 0 <= length <= len(self.body):
                raise Illegal("length of a list")
            values += [self._number(kind) for _ in range(int(length))]
        return values

    def _number(self, kind: str) -> float:
        size = struct.calcsize("<" + kind)
        if self.at + size > len(self.body):
            raise Illegal("truncated")
        self.at += size
        return struct.unpack_from(self.order + kind, self.body, self.at - size)[0]

    def _text(self, properties: list[tuple[str, str, str]]) -> list[float]:
        if not self.lines:
            raise Illegal("truncated")
        words, values = self.lines.pop(0), []
        for _, kind, count_kind in properties:
            length = int(_text_number(words, "I")) if count_kind else 1
            values += [_text_number(words, kind) for _ in range(length)]
        if words:
            raise Illegal("more numbers than properties")
        return values

    def rest(self) -> bool:
        return any(self.lines) if not self.order else bool(self.body[self.at :].strip())


def _text_number(words: list[str], kind: str) -> float:
    try:
        value = float(words.pop(0))
    except (IndexError, ValueError) as error:
        raise Illegal("not a number") from error
    if kind in "bBhHiI" and np.isfinite(value):
        low, high = np.iinfo(kind).min, np.iinfo(kind).max
        if not low <= value <= high:
            raise Illegal("an integer out of its type's range")
    return value


def ply_vertices(data: bytes) -> PlyVertices:
    """The vertices of a PLY file (Turk 1994)."""
    encoding, elements, body = ply_header(data)
    rows, vertices = _Rows(encoding, body), None
    for name, count, properties in elements:
        if not properties:
            table: list[list[float]] = []
        elif count > len(data):
            raise Illegal("more rows than bytes")
        else:
            table = [rows.row(properties) for _ in range(count)]
        if name == "vertex" and vertices is None:
            if any(count_kind for _, _, count_kind in properties):
                raise Illegal("lists in vertices are not read here")
            columns = (
                np.array(table, np.float64).reshape(count if properties else 0, len(properties)).T
            )
            names = [entry[0] for entry in properties]
            vertices = (
                dict(zip(names, columns, strict=True)),
                {n: k for n, k, _ in properties},
                count,
            )
            if len(elements) > 1 and elements[-1][0] != "vertex":
                return PlyVertices(*vertices, leftover=False)  # later elements aren't read
    if vertices is None:
        raise Illegal("no vertices")
    return PlyVertices(*vertices, leftover=rows.rest())


def ply_header(data: bytes) -> tuple[str, list, bytes]:
    lines, rest, elements, encodings = [], data, [], []
    while lines[-1:] != [["end_header"]]:
        line, newline, rest = rest.partition(b"\n")
        if not newline:
            raise Illegal("no end of the header")
        lines.append(line.decode("latin-1").split())
    if data[:3] != b"ply" or lines[0] != ["ply"]:
        raise Illegal("no PLY file")
    for words in lines[1:-1]:
        if words[:1] == ["format"]:
            encodings.append(words[1] if len(words) > 1 else "")
        elif words[:1] == ["element"]:
            if len(words) != 3 or not (words[2].isascii() and words[2].isdigit()):
                raise Illegal("element")
            elements.append((words[1], int(words[2]), []))
        elif words[:1] == ["property"] and elements:
            elements[-1][2].append(_ply_property(words))
        elif words[:1] not in ([], ["comment"], ["obj_info"]):
            raise Illegal("header line")
    if len(encodings) != 1 or encodings[0] not in (
        "ascii",
        "binary_little_endian",
        "binary_big_endian",
    ):
        raise Illegal("format")
    for _, _, properties in elements:
        if len({entry[0] for entry in properties}) < len(properties):
            raise Illegal("two properties of one name")
    if sum(element[0] == "vertex" for element in elements) > 1:
        raise Illegal("two elements of vertices")
    return encodings[0], elements, rest


def _ply_property(words: list[str]) -> tuple[str, str, str]:
    if len(words) == 3 and words[1] in TYPES:
        return words[2], TYPES[words[1]], ""
    if len(words) == 5 and words[1] == "list" and words[2] in TYPES and words[3] in TYPES:
        return words[4], TYPES[words[3]], TYPES[words[2]]
    raise Illegal("property")


# ---- OBJ -----------------------------------------------------------------------------------------


def obj_triangles(data: bytes) -> np.ndarray:
    """The corners (F, 3, 3) of an OBJ's faces, polygons cut into fans; raises where a line of v or
    f isn't one.
    """
    vertices, triangles = [], []
    for line in data.decode("utf-8", errors="replace").replace("\\\n", " ").split("\n"):
        words = line.split("#")[0].split()
        if words[:1] == ["v"]:
            vertices.append(_coordinates(words[1:]))
        elif words[:1] == ["f"]:
            triangles += _fan([_index(word, len(vertices)) for word in words[1:]])
    if any(index >= len(vertices) for triangle in triangles for index in triangle):
        raise Illegal("a face names a vertex that doesn't exist")
    return np.array(vertices, np.float64).reshape(-1, 3)[
        np.array(triangles, np.int64).reshape(-1, 3)
    ]


def _coordinates(words: list[str]) -> list[float]:
    if len(words) < 3:
        raise Illegal("vertex")
    return [_text_number([word], "d") for word in words[:3]]


def _index(word: str, count: int) -> int:
    try:
        index = int(word.split("/")[0])
    except ValueError as error:
        raise Illegal("index") from error
    if index == 0 or index < -count:
        raise Illegal("index")
    return index - 1 if index > 0 else count + index


def _fan(corners: list[int]) -> list[tuple[int, int, int]]:
    return [(corners[0], corners[i], corners[i + 1]) for i in range(1, len(corners) - 1)]


# ---- NPY, SPZ, checkpoints -----------------------------------------------------------------------


def npy_array(data: bytes) -> np.ndarray:
    """An NPY file of version 1 to 3 that holds one array of plain numbers or text and nothing
    else.
    """
    if data[:6] != b"\x93NUMPY" or data[6:7] not in (b"\1", b"\2", b"\3"):
        raise Illegal("no NPY file")
    width = 2 if data[6] == 1 else 4
    size = int.from_bytes(data[8 : 8 + width], "little")
    try:
        header = ast.literal_eval(
            data[8 + width : 8 + width + size]
            .decode("utf-8" if data[6] == 3 else "latin-1")
            .strip()
        )
        dtype, shape = np.dtype(header["descr"]), tuple(header["shape"])
    except (
        ValueError,
        SyntaxError,
        TypeError,
        KeyError,
        UnicodeDecodeError,
        MemoryError,
        RecursionError,
    ) as error:
        raise Illegal("header") from error
    body = data[8 + width + size :]
    if dtype.hasobject or any(
        not isinstance(n, int) or isinstance(n, bool) or n < 0 for n in shape
    ):
        raise Illegal("type or shape")
    count = 1
    for n in shape:
        count *= n
    if count * dtype.itemsize != len(body):
        raise Illegal("size")
    return np.frombuffer(body, dtype).reshape(shape, order="F" if header["fortran_order"] else "C")


def gunzipped(data: bytes) -> bytes:
    """One whole gzip member whose checksum holds."""
    stream = zlib.decompressobj(16 + zlib.MAX_WBITS)
    try:
        content = stream.decompress(data, 1 << 26)
    except zlib.error as error:
        raise Illegal("gzip") from error
    if not stream.eof:
        raise Illegal("truncated")
    return content


def checked_archive(data: bytes) -> None:
    """A zip archive all of whose checksums hold: our own of the whole file where it has one, and
    those of its members.
    """
    if (
        data[-71:-64] == b"sha256:"
        and hashlib.sha256(data[:-64]).hexdigest().encode() != data[-64:]
    ):
        raise Illegal("checksum of the file")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if archive.testzip() is not None:
            raise Illegal("checksum of a member")


# ---- GLB -----------------------------------------------------------------------------------------

GLTF_TYPES = {5121: "u1", 5123: "u2", 5125: "u4", 5126: "f4"}
SIMPLE = {"POSITION", "NORMAL", "TEXCOORD_0", "COLOR_0"}


def glb_triangles(data: bytes) -> Optional[np.ndarray]:
    """The corners (F, 3, 3) in the world of a GLB (glTF 2.0) of plain triangles; None for
    features that this reader doesn't support.
    """
    document, binary = _glb_chunks(data)
    try:
        scene = document["scenes"][document.get("scene", 0)]
        triangles = [_placed(document, binary, node, np.eye(4), 0) for node in scene["nodes"]]
    except (KeyError, IndexError, TypeError, AttributeError, ValueError, OverflowError):
        return None  # the result for an incomplete document isn't specified
    return np.concatenate(triangles) if triangles else None


def glb_document(data: bytes) -> dict:
    """The JSON of a GLB."""
    return _glb_chunks(data)[0]


def _glb_chunks(data: bytes) -> tuple[dict, bytes]:
    if data[:4] != b"glTF" or len(data) < 20 or data[16:20] != b"JSON":
        raise Illegal("no GLB")
    size = int.from_bytes(data[12:16], "little")
    try:
        return json.loads(data[20 : 20 + size]), data[20 + size + 8 :]
    except (ValueError, RecursionError) as error:
        raise Illegal("JSON") from error


def _placed(document: dict, binary: bytes, node: int, above: np.ndarray, depth: int) -> np.ndarray:
    entry = document["nodes"][node]
    if depth > 20 or {"rotation", "scale", "translation", "skin", "camera"} & entry.keys():
        raise KeyError("not known here")
    here = above @ np.array(entry.get("matrix", np.eye(4)), np.float64).reshape(4, 4).T
    parts = [
        _placed(document, binary, child, here, depth + 1) for child in entry.get("children", [])
    ]
    if "mesh" in entry:
        for primitive in document["meshes"][entry["mesh"]]["primitives"]:
            corners = _primitive(document, binary, primitive)
            parts.append(corners @ here[:3, :3].T + here[:3, 3])
    return np.concatenate([np.zeros((0, 3, 3)), *parts])


def _primitive(document: dict, binary: bytes, primitive: dict) -> np.ndarray:
    if primitive.get("mode", 4) != 4 or not primitive["attributes"].keys() <= SIMPLE:
        raise KeyError("not known here")
    positions = _accessor(document, binary, primitive["attributes"]["POSITION"], "VEC3", ("f4",))
    indices = _accessor(document, binary, primitive["indices"], "SCALAR", ("u1", "u2", "u4"))
    return positions.astype(np.float64)[indices.reshape(-1, 3)]


def _accessor(
    document: dict, binary: bytes, number: int, kind: str, types: tuple[str, ...]
) -> np.ndarray:
    entry = document["accessors"][number]
    view = document["bufferViews"][entry["bufferView"]]
    own = GLTF_TYPES[entry["componentType"]]
    if (
        entry["type"] != kind
        or own not in types
        or "byteStride" in view
        or "sparse" in entry
        or view.get("buffer") != 0
    ):
        raise KeyError("not known here")
    width, start = 3 if kind == "VEC3" else 1, view.get("byteOffset", 0)
    part = binary[start : start + view["byteLength"]]
    count = entry["count"] * width
    return np.frombuffer(part, own, count, entry.get("byteOffset", 0)).reshape(-1, width)
