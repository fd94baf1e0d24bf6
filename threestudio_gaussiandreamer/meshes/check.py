"""Checks of OBJ and PLY files before trimesh reads them: what it would guess at, or skip in
silence.
"""

import functools
import re
from pathlib import Path

from ..formats.ply_table import PlyTable
from .budget import fail

# No text fits a pattern here in two ways: otherwise a long line would take quadratic time.
NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf)"
CORNER = rb"-?[1-9]\d*(?:/(?:-?[1-9]\d*)?){0,2}"
ENTRY = rb"(?:[ \t]+%b)" % NUMBER
FIRST_VERTEX = re.compile(rb"^v (.*)$", re.MULTILINE)
RELATIVE_FACE = re.compile(rb"^f .*-", re.MULTILINE)


def check_mesh_file(path: Path) -> None:
    """Check what a reader could only guess at; other formats are left to their reader.

    Raises:
        UserError: the file is damaged, or uses what trimesh reads wrongly.
    """
    extension = path.suffix.lower()
    if extension == ".ply":
        PlyTable.read(path)
    if extension == ".obj":
        _check_obj(path.read_bytes(), path)


def _check_obj(data: bytes, path: Path) -> None:
    """Check that lines of vertices and faces are whole: trimesh stops reading numbers at the first
    that isn't one.
    """
    text = data.replace(b"\\\r\n", b"").replace(b"\\\n", b"")
    first = FIRST_VERTEX.search(text)
    if wrong := _wrong_obj_line(len(first[1].split()) if first else 3).search(text):
        number = text.count(b"\n", 0, wrong.start()) + 1
        fail(
            path, f"line {number} is no vertex or face: {wrong[0][:80].decode(errors='replace')!r}"
        )
    relative = RELATIVE_FACE.search(text)
    if relative and text.find(b"\nv ", relative.start()) >= 0:
        fail(
            path,
            "its faces count backwards from vertices that others follow, which isn't read "
            "here: export it with absolute indices",
        )


@functools.cache
def _wrong_obj_line(width: int) -> re.Pattern[bytes]:
    """Return a pattern of lines that begin as one of vertices or faces and aren't.

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
