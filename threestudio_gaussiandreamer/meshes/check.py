"""Check OBJ files before trimesh reads them, for damage that it would ignore silently or read
wrongly.
"""

import functools
import re
from pathlib import Path

from .budget import fail

# No text matches one of these patterns in two ways: backtracking on a long line would take
# quadratic time.
NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf)"
CORNER = rb"-?[1-9]\d*(?:/(?:-?[1-9]\d*)?){0,2}"
ENTRY = rb"(?:[ \t]+%b)" % NUMBER
FIRST_VERTEX = re.compile(rb"^v (.*)$", re.MULTILINE)
RELATIVE_FACE = re.compile(rb"^f .*-", re.MULTILINE)


def check_mesh_file(path: Path) -> None:
    """Check an OBJ file; other formats are left to their reader.

    Raises:
        UserError: the file is damaged, or uses a feature that trimesh reads wrongly.
    """
    if path.suffix.lower() == ".obj":
        _check_obj(path.read_bytes(), path)


def _check_obj(data: bytes, path: Path) -> None:
    """Check that lines of vertices and faces are valid, since trimesh stops reading at the first
    text that isn't a number; reject relative indices.
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
    """Return a pattern of lines that begin like a vertex or face but are not valid.

    A vertex has 3 numbers, or 6 with its colour. If the first vertex has 4 (with a weight) or 7
    (with alpha), all must have as many: trimesh splits the numbers of all vertices into rows of the
    first one's width without checking each line."""
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
