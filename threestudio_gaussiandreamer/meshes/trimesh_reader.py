"""Parts of mesh files in the formats that trimesh reads: OBJ, STL, OFF, ..."""

import functools
import io
import logging
import re
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..core.errors import UserError
from .gltf import LARGEST_UV
from .mesh import Mesh, linear_to_srgb, unit_rgb
from .side_files import Budget, SideFiles, decode_image, fail, open_texture, utf8

MATERIALS = "materials"
"""The name by which trimesh asks for the joined material libraries of an OBJ; all other files that
it asks for are textures.
"""
UNSET_COLOR = (102, 102, 102)
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""

LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+(.*)$", re.MULTILINE)
END_OF_NAME = re.compile(r"(?<=\.mtl)[\"']?\s+", re.IGNORECASE)
"""Between the names of libraries on one line; names may have spaces."""
MATERIAL = re.compile(rb"^[ \t]*newmtl[ \t]+(.*?)\s*$", re.MULTILINE)
MATERIAL_USED = re.compile(rb"^[ \t]*usemtl\b", re.MULTILINE)
# No text matches one of these patterns in two ways: backtracking on a long line would take
# quadratic time.
NUMBER = rb"[-+]?(?:\d+(?:\.\d*)?(?:[eE][-+]?\d+)?|\.\d+(?:[eE][-+]?\d+)?|nan|inf)"
CORNER = rb"-?[1-9]\d*(?:/(?:-?[1-9]\d*)?){0,2}"
ENTRY = rb"(?:[ \t]+%b)" % NUMBER
FIRST_VERTEX = re.compile(rb"^v (.*)$", re.MULTILINE)
ROWS_AND_FACES = re.compile(rb"^(v|vt|vn|f) (.*)$", re.MULTILINE)
RELATIVE_FACE = re.compile(rb"^f .*-", re.MULTILINE)

log = logging.getLogger(__name__)


def read_with_trimesh(path: Path) -> list[Mesh]:
    """Read the parts of a file, transformed by its scene graph; parts that consist of points have
    no faces.

    Raises:
        UserError: the file is damaged, exceeds its budget, or references something that isn't a
            regular file.
    """
    try:
        return [_require_fitting(part, path) for part in _parts(path, Budget(path))]
    except UserError:
        raise
    except Exception as error:  # trimesh's readers raise exceptions of many types
        fail(path, f"{type(error).__name__}: {error}")


def _parts(path: Path, budget: Budget) -> list[Mesh]:
    import trimesh

    files, content = _Resolver(path, budget), path.read_bytes()
    if path.suffix.lower() == ".obj":
        content = files.with_libraries(_checked_obj(utf8(content), path))
    elif path.suffix.lower() == ".stl":
        content = _exact_stl(content, path)
    scene = trimesh.load_scene(
        io.BytesIO(content),
        file_type=path.suffix.lower().lstrip("."),
        resolver=files,
        process=False,
    )
    if files.refused:
        raise files.refused
    if path.suffix.lower() == ".off":
        _add_off_colors(scene, content.decode("utf-8-sig", errors="replace"), path)
    parts = []
    for node in scene.graph.nodes_geometry:
        world, name = scene.graph[node]
        geometry = scene.geometry[name]
        if len(getattr(geometry, "vertices", ())):
            part = _colored(_surface(geometry, path, budget), geometry, files)
            parts.append(part._replace(vertices=_placed(part.vertices, world)))
    return parts


def _checked_obj(data: bytes, path: Path) -> bytes:
    """Return an OBJ whose lines of vertices and faces are valid, since trimesh stops reading at the
    first text that isn't a number, and whose faces count from the first vertex.
    """
    text = data.replace(b"\\\r\n", b"").replace(b"\\\n", b"")
    first = FIRST_VERTEX.search(text)
    if wrong := _wrong_obj_line(len(first[1].split()) if first else 3).search(text):
        number = text.count(b"\n", 0, wrong.start()) + 1
        fail(
            path, f"line {number} is no vertex or face: {wrong[0][:80].decode(errors='replace')!r}"
        )
    if not RELATIVE_FACE.search(text):
        return text
    counts = {b"v": 0, b"vt": 0, b"vn": 0}

    def absolute(number: bytes, count: int) -> bytes:
        if not number.startswith(b"-"):
            return number
        if int(number) < -count:
            fail(path, f"a face names number {int(number)} of {count} vertices")
        return b"%d" % (count + 1 + int(number))

    def line(found: re.Match[bytes]) -> bytes:
        if found[1] in counts:
            counts[found[1]] += 1
            return found[0]
        corners = (zip(x.split(b"/"), counts.values(), strict=False) for x in found[2].split())
        return b"f " + b" ".join(b"/".join(absolute(*x) for x in corner) for corner in corners)

    return ROWS_AND_FACES.sub(line, text)


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


def _exact_stl(data: bytes, path: Path) -> bytes:
    """Return a binary STL without what follows its last triangle, and an STL of text as it is."""
    if b"facet" in data[:1024] or b"endsolid" in data[:1024]:
        return data
    size = 84 + 50 * int.from_bytes(data[80:84], "little")
    if len(data) < size:
        fail(path, f"it is truncated or damaged: {size} bytes were expected, not {len(data)}")
    return data[:size]


def _add_off_colors(scene: Any, text: str, path: Path) -> None:
    """Set the colours of an OFF file's vertices, which trimesh doesn't read; log a warning for
    others, such as those of faces.
    """
    (kind, *counts), *lines = filter(
        None, (line.partition("#")[0].split() for line in text.splitlines())
    )
    (vertices, faces, *_), *lines = [counts, *lines] if counts else lines
    rows, polygons = lines[: int(vertices)], lines[int(vertices) :][: int(faces)]
    colors = _rgb_of([row[3:] for row in rows]) if kind.upper() in ("OFF", "COFF") else None
    has_more = "C" in kind.upper() or kind.upper() == "OFF" and any(len(row) > 3 for row in rows)
    of_faces = any(len(polygon) > int(polygon[0]) + 1 for polygon in polygons)
    if of_faces or has_more and colors is None:
        what = "faces" if of_faces else "vertices"
        log.warning(
            "%s: the colours of its %s aren't read; convert it to PLY to keep them", path, what
        )
    if colors is not None:
        (geometry,) = scene.geometry.values()
        geometry.visual.vertex_colors = colors


def _rgb_of(rows: list[list[str]]) -> Optional[np.ndarray]:
    """Return colours, written from 0 to 1 or to 255, as bytes; None if not every row has one."""
    try:
        colors = np.array([row[:3] for row in rows], float).reshape(-1, 3)
    except ValueError:  # of other lengths, or no numbers
        return None
    if len(colors) < len(rows) or not np.isfinite(colors).all():
        return None
    return (colors * (255 if colors.max() <= 1 else 1)).round().clip(0, 255).astype(np.uint8)


class _Resolver:
    """Resolver through which trimesh reads the files that a mesh references.

    trimesh catches the exceptions raised here, so the first UserError is kept in ``refused``.
    """

    def __init__(self, path: Path, budget: Budget) -> None:
        self.budget, self.file_name = budget, path.name
        self.refused: Optional[UserError] = None
        self._files = SideFiles(path, budget)
        self._pictures: dict[int, tuple[Any, np.ndarray]] = {}
        self._materials = b""

    def with_libraries(self, content: bytes) -> bytes:
        """Read all material libraries of an OBJ, of which trimesh reads one; return the OBJ with
        the joined one. A single material that no line uses is that of all faces.
        """
        lines = [utf8(line).decode() for line in LIBRARIES.findall(content)]
        names = [name for line in lines for name in END_OF_NAME.split(line.strip())]
        found = [self._files.read(name) for name in names]
        self._materials = b"\n".join(utf8(text) for text in found if text is not None)
        head, known = f"mtllib {MATERIALS}\n".encode(), MATERIAL.findall(self._materials)
        if len(known) == 1 and not MATERIAL_USED.search(content):
            head += b"usemtl " + known[0] + b"\n"
        return head + LIBRARIES.sub(b"", content)

    def get(self, name: str) -> bytes:
        if name == MATERIALS:
            return self._materials
        # options stand before the name of a texture, which may have spaces: -clamp on a 1.png
        ends = [word.end() for word in re.finditer(r"\s+", name) if name.startswith("-")]
        try:
            content = self._files.read(name, *(name[end:] for end in ends))
            if content is not None:
                # trimesh would read the part without a texture that can't be opened
                open_texture(content, repr(name[:80]), self.budget)
        except UserError as error:
            self.refused = self.refused or error
            raise
        if content is None:
            raise FileNotFoundError(name)
        return content

    __getitem__ = get

    def picture(self, image: Any) -> np.ndarray:
        """Decode an image that trimesh has opened; each image is decoded once."""
        if id(image) not in self._pictures:  # the image is kept, so that its id isn't reused
            name = str(image.info.get("file_path", ""))[:80]
            self._pictures[id(image)] = image, decode_image(image, repr(name), self.budget)
        return self._pictures[id(image)][1]


def _placed(vertices: np.ndarray, world: np.ndarray) -> np.ndarray:
    if np.array_equal(world, np.eye(4)):
        return vertices
    return vertices @ world[:3, :3].T + world[:3, 3]


def _surface(geometry: Any, path: Path, budget: Budget) -> Mesh:
    """Return vertices and faces of a geometry of trimesh."""
    vertices = np.array(geometry.vertices, dtype=np.float64)
    faces = np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), dtype=np.int64)
    budget.spend_geometry(len(vertices), len(faces))
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.shape[1:] != (3,):
        fail(
            path,
            f"it is damaged: vertices {vertices.shape} and faces {faces.shape} aren't of three "
            "numbers",
        )
    if len(faces) and (faces.min() < 0 or faces.max() >= len(vertices)):
        fail(path, f"it is damaged: a face names vertex {faces.max()} of {len(vertices)}")
    return Mesh(vertices=vertices, faces=faces)


def _colored(part: Mesh, geometry: Any, files: _Resolver) -> Mesh:
    """Return the part with the texture, vertex colours or face colours of trimesh's geometry."""
    visual = geometry.visual
    if not len(part.faces):
        colors = getattr(geometry, "colors", None)
        usual = colors is not None and len(colors) == len(part.vertices)
        return part._replace(vertex_colors=unit_rgb(colors)) if usual else part
    if visual.kind == "texture":
        return _with_material(part, visual, files)
    if visual.kind == "vertex":
        return part._replace(vertex_colors=unit_rgb(visual.vertex_colors))
    if visual.kind == "face":
        return part._replace(face_colors=unit_rgb(visual.face_colors))
    return part


def _with_material(part: Mesh, visual: Any, files: _Resolver) -> Mesh:
    """Return the part with its texture multiplied by the material's colour, or with that colour
    alone. Black with a texture is ignored, as programs write it that don't multiply.
    """
    texture, tint = _texture(visual.material, files), _tint(visual.material)
    if tint is not None and (texture is None or tint.any()):
        part = part._replace(vertex_colors=np.broadcast_to(tint, part.vertices.shape))
    if texture is None or visual.uv is None:
        return part
    uv = np.nan_to_num(np.asarray(visual.uv, dtype=np.float32)[:, :2])
    return part._replace(uv=uv.clip(-LARGEST_UV, LARGEST_UV), texture=texture)


def _texture(material: Any, files: _Resolver) -> Optional[np.ndarray]:
    """Return the colour texture of a material, or None if it has none.

    For an OBJ with coordinates but without a material trimesh creates a grey image, which is
    recognised by its missing file format and ignored.
    """
    image = getattr(material, "image", getattr(material, "baseColorTexture", None))
    return None if getattr(image, "format", None) is None else files.picture(image)


def _tint(material: Any) -> Optional[np.ndarray]:
    """Return the material's colour (3,) as sRGB values in [0, 1], or None if it has none."""
    linear = hasattr(material, "baseColorFactor")
    tint = getattr(material, "baseColorFactor" if linear else "diffuse", None)
    if tint is None or tuple(np.asarray(tint)[:3]) == UNSET_COLOR:
        return None
    tint = unit_rgb(np.asarray(tint)[None])[0]
    return linear_to_srgb(tint) if linear else tint


def _require_fitting(part: Mesh, path: Path) -> Mesh:
    """Return the part after checking that its colours have one row per vertex or face."""
    count = {
        "uv": (len(part.vertices), 2),
        "vertex_colors": (len(part.vertices), 3),
        "face_colors": (len(part.faces), 3),
    }
    for name, shape in count.items():
        if (values := getattr(part, name)) is not None and values.shape != shape:
            fail(path, f"it is damaged: its {name} are {values.shape}, {shape} was expected")
    return part
