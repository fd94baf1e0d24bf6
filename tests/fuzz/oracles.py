"""Strict readers, written from the formats' specifications, which raise :class:`Illegal`."""

import ast
import hashlib
import io
import json
import math
import re
import struct
import zipfile
import zlib
from typing import NamedTuple

import numpy as np
from PIL import Image

TYPES = dict(char="b", uchar="B", short="h", ushort="H", int="i", uint="I", float="f", double="d")
TYPES |= dict(int8="b", uint8="B", int16="h", uint16="H", int32="i", uint32="I")
TYPES |= dict(float32="f", float64="d")


class Illegal(Exception):
    """The bytes are not a valid file of this format."""


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
        self.words = [] if self.order else body.decode("latin-1").split()
        self.lines = [] if self.order else [len(x.split()) for x in body.split(b"\n") if x.strip()]

    def row(self, properties: list[tuple[str, str, str]]) -> list[float]:
        values = []
        for _, kind, count_kind in properties:
            length = self._number(count_kind) if count_kind else 1
            if not (0 <= length <= len(self.body) and length == int(length)):
                raise Illegal("length of a list")
            values += [self._number(kind) for _ in range(int(length))]
        return values

    def _number(self, kind: str) -> float:
        if not self.order:
            return _text_number(self.words)
        size = struct.calcsize("<" + kind)
        if self.at + size > len(self.body):
            raise Illegal("truncated")
        self.at += size
        return struct.unpack_from(self.order + kind, self.body, self.at - size)[0]

    def rest(self) -> bool:
        return bool(self.body[self.at :].strip()) if self.order else bool(self.words)


def _text_number(words: list[str]) -> float:
    try:
        word = words.pop(0)
        if "_" in word:
            raise ValueError
        return float(word)
    except (IndexError, ValueError) as error:
        raise Illegal("not a number") from error


def ply_vertices(data: bytes) -> PlyVertices:
    """The vertices of a PLY file (Turk 1994)."""
    encoding, elements, body = ply_header(data)
    rows, vertices = _Rows(encoding, body), None
    for _, count, properties in elements:
        if any(count_kind for _, _, count_kind in properties):
            break
        lines = rows.lines[: count if properties else 0]
        if any(length != len(properties) for length in lines):
            raise Illegal("more or fewer numbers than properties")
        rows.lines = rows.lines[len(lines) :]
    for name, count, properties in elements:
        if properties and count > len(data):
            raise Illegal("more rows than bytes")
        table = [rows.row(properties) for _ in range(count if properties else 0)]
        if name == "vertex" and vertices is None:
            if any(count_kind for _, _, count_kind in properties):
                raise Illegal("lists in vertices are not read here")
            columns = np.array(table, np.float64).reshape(len(table), len(properties)).T
            types = {name: kind for name, kind, _ in properties}
            vertices = dict(zip(types, columns, strict=True)), types, count
            for kind, column in zip(types.values(), columns, strict=True):
                whole = np.iinfo(kind) if kind in "bBhHiI" else None
                if whole and ((column < whole.min) | (column > whole.max)).any():
                    raise Illegal("an integer out of its type's range")
            if len(elements) > 1 and elements[-1][0] != "vertex":
                return PlyVertices(*vertices, leftover=False)  # later elements aren't read
    if vertices is None:
        raise Illegal("no vertices")
    return PlyVertices(*vertices, leftover=rows.rest())


def ply_header(data: bytes) -> tuple[str, list, bytes]:
    """Return encoding, elements as (name, count, properties), and body."""
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
    if encodings not in (["ascii"], ["binary_little_endian"], ["binary_big_endian"]):
        raise Illegal("format")
    if any(len({entry[0] for entry in own}) < len(own) for _, _, own in elements):
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


def npy_array(data: bytes) -> np.ndarray:
    """An NPY file of version 1 to 3 with one array of plain numbers or text and nothing else."""
    if data[:6] != b"\x93NUMPY" or data[6:7] not in (b"\1", b"\2", b"\3"):
        raise Illegal("no NPY file")
    width = 2 if data[6] == 1 else 4
    end = 8 + width + int.from_bytes(data[8 : 8 + width], "little")
    try:
        text = data[8 + width : end].decode("utf-8" if data[6] == 3 else "latin-1")
        header = ast.literal_eval(text.strip())
        dtype, shape = np.dtype(header["descr"]), tuple(header["shape"])
    except (ValueError, SyntaxError, TypeError, KeyError, MemoryError, RecursionError) as error:
        raise Illegal("header") from error
    if dtype.hasobject or any(type(n) is not int or n < 0 for n in shape):
        raise Illegal("type or shape")
    if math.prod(shape) * dtype.itemsize != len(data) - end:
        raise Illegal("size")
    order = "F" if header["fortran_order"] else "C"
    return np.frombuffer(data[end:], dtype).reshape(shape, order=order)


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
    """A zip archive all of whose checksums hold, our own of the whole file too."""
    digest = hashlib.sha256(data[:-64]).hexdigest().encode()
    if data[-71:-64] == b"sha256:" and digest != data[-64:]:
        raise Illegal("checksum of the file")
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        if archive.testzip() is not None:
            raise Illegal("checksum of a member")


def glb_document(data: bytes) -> dict:
    """The JSON of a GLB."""
    if data[:4] != b"glTF" or len(data) < 20 or data[16:20] != b"JSON":
        raise Illegal("no GLB")
    try:
        return json.loads(data[20 : 20 + int.from_bytes(data[12:16], "little")])
    except (ValueError, RecursionError) as error:
        raise Illegal("JSON") from error


def compressed_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in a compressed PLY: 11, 10 and 11 bits between the limits of 256."""
    encoding, elements, body = ply_header(data)
    if encoding == "ascii":
        raise Illegal("text")
    order, at, tables = "<" if "little" in encoding else ">", 0, {}
    for name, count, properties in elements:
        row = struct.Struct(order + "".join(kind for _, kind, _ in properties))
        if at + count * row.size > len(body):
            raise Illegal("truncated")
        names = [entry[0] for entry in properties]
        rows = (row.unpack_from(body, at + i * row.size) for i in range(count))
        tables[name] = [dict(zip(names, values, strict=True)) for values in rows]
        at += count * row.size
    means = []
    for index, vertex in enumerate(tables["vertex"]):
        word, chunk = vertex["packed_position"], tables["chunk"][index // 256]
        shares = (word >> 21) / 2047, (word >> 11 & 1023) / 1023, (word & 2047) / 2047
        low, high = ([chunk[f"{end}_{axis}"] for axis in "xyz"] for end in ("min", "max"))
        means.append([a * (1 - t) + b * t for a, b, t in zip(low, high, shares, strict=True)])
    return np.array(means, np.float64).reshape(-1, 3)


def sog_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in a SOG archive whose images Pillow decodes."""
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        meta = json.loads(archive.read("meta.json"))
        means, count = meta["means"], meta["count"]
        images = [Image.open(io.BytesIO(archive.read(name))) for name in means["files"][:2]]
    low, high = (np.array(image.convert("RGB"), int).reshape(-1, 3)[:count] for image in images)
    start, end = (np.array(means[key], float) for key in ("mins", "maxs"))
    logs = start + (end - start) * ((high * 256 + low) / 65535)
    return np.sign(logs) * (np.exp(np.abs(logs)) - 1)


def ksplat_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in the records of a .ksplat file."""
    sections, level = struct.unpack_from("<I", data, 4)[0], struct.unpack_from("<H", data, 20)[0]
    at, means = 4096 + 1024 * sections, []
    for head in range(4096, at, 1024):
        count, room, bucket, buckets, block, stride = struct.unpack_from("<IIIIfH", data, head)
        steps, _, full, partial = struct.unpack_from("<4I", data, head + 24)
        harmonics = 3 * ((struct.unpack_from("<H", data, head + 40)[0] + 1) ** 2 - 1)
        size = (44 + 4 * harmonics, 24 + 2 * harmonics, 24 + harmonics)[level]
        lengths = [bucket] * full + list(struct.unpack_from(f"<{partial}I", data, at))
        owners = [place for place, length in enumerate(lengths) for _ in range(length)]
        rows = at + 4 * partial + stride * buckets
        for row in range(count):
            if level == 0:
                means.append(struct.unpack_from("<3f", data, rows + size * row))
                continue
            center = struct.unpack_from("<3f", data, at + 4 * partial + 12 * owners[row])
            numbers, far = struct.unpack_from("<3H", data, rows + size * row), steps or 32767
            pairs = zip(numbers, center, strict=True)
            means.append([(n - far) * (block / 2 / far) + c for n, c in pairs])
        at = rows + size * room
    return np.array(means, np.float64).reshape(-1, 3)


def usda_means(data: bytes) -> np.ndarray:
    """The positions (N, 3) in the one line of a USDA layer that gives them."""
    declared = rb"^\s*(?:custom )?(?:uniform )?point3f\[\] positions = \[(.*)\]"
    found = re.findall(declared, data, re.MULTILINE)
    if len(found) != 1:
        raise Illegal(f"{len(found)} lines with positions")
    return np.array([float(number) for number in re.findall(rb"[^(), ]+", found[0])]).reshape(-1, 3)
