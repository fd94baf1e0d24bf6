"""Parts of mesh files in the formats that trimesh reads: OBJ, STL, OFF, ..."""

import io
import logging
import re
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..core.errors import UserError
from .budget import Budget, fail
from .check import check_mesh_file
from .colors import linear_to_srgb, unit_rgb
from .gltf import LARGEST_UV
from .mesh import Mesh
from .side_files import SideFiles, utf8
from .textures import decode_image, open_texture

MATERIALS = ".mtl"
"""Ending of an OBJ's material libraries; all other files that trimesh asks for are textures."""

UNSET_COLOR = (102, 102, 102)
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""

TEXTURE_OPTIONS = re.compile(
    r"^\s*(-[a-z]+\s+((on|off|[rgbmlz]|sphere|cube_[a-z]+|[-+.\dex]+)\s+){1,3})+", re.IGNORECASE
)
"""Options in front of the name of a texture in an OBJ's material, such as ``-clamp on``."""

log = logging.getLogger(__name__)


def read_with_trimesh(path: Path) -> list[Mesh]:
    """Read the parts of a file, transformed by its scene graph; parts that consist of points have
    no faces.

    Raises:
        UserError: the file is damaged, exceeds its budget, or references something that isn't a
            regular file.
    """
    try:
        check_mesh_file(path)
        return [_require_fitting(part, path) for part in _parts(path, Budget(path))]
    except UserError:
        raise
    except Exception as error:  # trimesh's readers raise exceptions of many types
        fail(path, f"{type(error).__name__}: {error}")


def _parts(path: Path, budget: Budget) -> list[Mesh]:
    import trimesh

    files, content = _Resolver(path, budget), path.read_bytes()
    content = utf8(content) if path.suffix.lower() == ".obj" else content
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

    def get(self, name: str) -> bytes:
        try:
            content = self._files.read(name, TEXTURE_OPTIONS.sub("", name))
            is_library = name.strip("\"' \t").lower().endswith(MATERIALS)
            if content is not None and not is_library:
                # trimesh would read the part without a texture that can't be opened
                open_texture(content, repr(name[:80]), self.budget)
        except UserError as error:
            self.refused = self.refused or error
            raise
        if content is None:
            raise FileNotFoundError(name)
        return utf8(content) if is_library else content

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
    alone.
    """
    texture, tint = _texture(visual.material, files), _tint(visual.material)
    if tint is not None:
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
