"""What trimesh would believe, or pass over in silence, in a damaged GLB, glTF, OBJ or PLY file:
looked at before it reads the file.
"""

import functools
import json
import re
import struct
from pathlib import Path
from typing import Any, NoReturn

from ..core.errors import UserError
from ..formats.ply_table import PlyTable

NUMBER = rb"[-+]?(?:\d+\.?\d*(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf)"
CORNER = rb"-?[1-9]\d*(?:/(?:-?[1-9]\d*)?){0,2}"
ENTRY = rb"(?:[ \t]+%b)" % NUMBER
FIRST_VERTEX = re.compile(rb"^v (.*)$", re.MULTILINE)
RELATIVE_FACE = re.compile(rb"^f .*-", re.MULTILINE)


def check_mesh_file(path: Path) -> None:
    """Look for what a reader could only guess at; other formats are left to their reader.

    Raises:
        UserError: the file is damaged, or uses what trimesh reads wrongly.
    """
    if path.suffix.lower() == ".ply":
        PlyTable.read(path)
    check = {".glb": _check_glb, ".gltf": _check_gltf, ".obj": _check_obj}.get(path.suffix.lower())
    if check is not None:
        try:
            check(path.read_bytes(), path)
        except OSError as error:
            raise UserError(f"cannot read {str(path)!r}: {error.strerror or error}") from error


def _check_glb(data: bytes, path: Path) -> None:
    """Chunks that end within the file: trimesh makes room for what they announce."""
    at, chunks = 12, []
    while at + 8 <= len(data):
        size, kind = struct.unpack_from("<I4s", data, at)
        at += 8 + size
        chunks.append((kind, data[at - size : at]))
    if data[:4] != b"glTF" or not chunks or chunks[0][0] != b"JSON" or at > len(data):
        _fail(path, "its chunks don't fill it")
    _check_gltf(chunks[0][1], path)


def _check_gltf(data: bytes, path: Path) -> None:
    """Strict JSON, of which trimesh guesses the encoding, and numbers that are stored, for which it
    would put zeros.
    """
    try:
        document = json.loads(data.decode("utf-8"))
    except (ValueError, RecursionError) as error:
        _fail(path, f"its JSON isn't valid ({str(error)[:100]})")
    accessors = document.get("accessors", []) if isinstance(document, dict) else None
    if not isinstance(accessors, list) or not all(
        isinstance(accessor, dict) for accessor in accessors
    ):
        _fail(path, "its JSON isn't that of a glTF file")
    if not all(_is_stored(accessor) for accessor in accessors):
        _fail(
            path,
            "the numbers of an accessor aren't in the file; if they are compressed (Draco, "
            "meshopt), export it without that",
        )


def _is_stored(accessor: dict[str, Any]) -> bool:
    return (
        isinstance(accessor.get("bufferView"), int)
        and isinstance(accessor.get("count"), int)
        and accessor["count"] >= 0
    )


def _check_obj(data: bytes, path: Path) -> None:
    """Lines of vertices and faces that are whole: trimesh stops reading numbers at the first that
    isn't one.
    """
    text = data.replace(b"\\\r\n", b"").replace(b"\\\n", b"")
    first = FIRST_VERTEX.search(text)
    if wrong := _wrong_obj_line(len(first[1].split()) if first else 3).search(text):
        number = text.count(b"\n", 0, wrong.start()) + 1
        _fail(
            path, f"line {number} is no vertex or face: {wrong[0][:80].decode(errors='replace')!r}"
        )
    relative = RELATIVE_FACE.search(text)
    if relative and text.find(b"\nv ", relative.start()) >= 0:
        _fail(
            path,
            "its faces count backwards from vertices that others follow, which isn't read "
            "here: export it with absolute indices",
        )


@functools.cache
def _wrong_obj_line(width: int) -> re.Pattern[bytes]:
    """Finds a line that begins as one of vertices or faces and isn't.

    A vertex has 3 numbers, or 6 with its colour; or all of them have as many as the first, 4 (with
    a weight) or 7 (with alpha): trimesh cuts the numbers of all vertices into rows as wide as the
    first if only their total fits."""
    vertex = b"%b{%d}" % (ENTRY, width) if width in (4, 7) else b"%b{3}(?:%b{3})?" % (ENTRY, ENTRY)
    right = rb"v(?= )%b|vt(?= )%b{2,3}|vn(?= )%b{3}|vp .*|f(?= )(?:[ \t]+%b){3,}" % (
        vertex,
        ENTRY,
        ENTRY,
        CORNER,
    )
    return re.compile(
        rb"^(?=[ \t]*[vf])(?!(?:%b)[ \t]*\r?$).*$" % right, re.MULTILINE | re.IGNORECASE
    )


def _fail(path: Path, problem: str) -> NoReturn:
    raise UserError(f"can't read the mesh {str(path)!r}: {problem}")
