"""Load triangle meshes in the world's pose: z up, front = +x, box centred at the origin, half the
longest side of the box = ``scale``.

Colours are unlit: texture times vertex colour, else vertex, face or material colour, else grey 0.5;
all are display values (sRGB) in [0, 1]. A texture's alpha channel is ignored.

``up="auto"`` is +y for glTF, OBJ and other modelling formats and +z for PLY, STL and OFF. The front
is the axis after the up axis (x -> y -> z -> x): +z for y-up files, as glTF says, +x for z-up ones.

Formats but glTF and PLY are read by trimesh, after a check of what it would ignore silently or read
wrongly. A PLY has texture coordinates of vertices (Blender) or of the corners of faces (MeshLab);
its textures are named by comments ``TextureFile``, which Blender doesn't write."""

import io
import logging
import re
from pathlib import Path
from typing import Any, Optional

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..formats.ply import COLORS, MEANS, Lists, PlyTable, unit_colors
from ..formats.reading import Unreadable, reading, require
from .gltf import LARGEST_UV, read_gltf
from .mesh import GREY, MAX_NON_FINITE, Mesh, face_areas, linear_to_srgb, merged, unit_rgb
from .side_files import Budget, SideFiles, decode_image, decode_texture, open_texture, utf8

GLTF_FORMATS = ("glb", "gltf")
Z_UP_FORMATS = ("ply", "stl", "off", "xyz")
AXES = dict(zip("+x +y +z -x -y -z".split(), [*np.eye(3), *-np.eye(3)], strict=True))
ASSETS = Path(__file__).parents[1] / "assets"

log = logging.getLogger(__name__)
INDICES = ("vertex_indices", "vertex_index")
COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Of vertices, by the names that programs give them."""
OF_CORNERS, TEXTURE_NUMBER, TEXTURE_FILE = "texcoord", "texnumber", "TextureFile "
MATERIALS = "materials"
"""By which trimesh asks for the joined libraries of an OBJ; what else it asks for are textures."""
UNSET_COLOR = (102, 102, 102)
"""trimesh's default for materials without a colour; ignored, since it would darken the texture."""
LIBRARIES = re.compile(rb"^[ \t]*mtllib[ \t]+(.*)$", re.MULTILINE)
END_OF_NAME = re.compile(r"(?<=\.mtl)[\"']?\s+", re.IGNORECASE)
"""Between the names of libraries on one line; names may have spaces."""
MATERIAL = re.compile(rb"^[ \t]*newmtl[ \t]+(.*?)\s*$", re.MULTILINE)
MATERIAL_USED = re.compile(rb"^[ \t]*usemtl\b", re.MULTILINE)
OBJ_NUMBERS = {b"v": (3, 4, 6, 7), b"vt": (2, 3), b"vn": (3,)}
"""Numbers on a line of an OBJ: 4 with a weight, 6 with a colour, 7 with alpha."""
NUMBER = re.compile(rb"(?i)[-+]?(?:(?:\d+(?:\.\d*)?|\.\d+)(?:e[-+]?\d+)?|nan|inf)")
CORNER = re.compile(rb"-?[1-9]\d*(?:/(?:-?[1-9]\d*)?){0,2}")


def load_mesh(
    path: str | Path, *, scale: float = 1.0, up: str = "auto", front: Optional[str] = None
) -> Mesh:
    """Read a mesh file, merge the parts of its scene, and transform it to the world's pose.

    Args:
        path: GLB or glTF, a file that trimesh reads (OBJ, PLY, STL, OFF, ...), or the bare name of
            a bundled one.
        scale: half the longest side of the result's box, world units, > 0.
        up, front: the file's axes, "+x" ... "-z"; the module's docstring describes the defaults.

    Raises:
        UserError: the file is missing, damaged or of an unknown format, has no faces or no area, or
            more than 5 % of its vertices aren't finite; or ``up`` or ``front`` is invalid.
    """
    path = mesh_file(path)
    rotation = pose_rotation(_extension(path), up, front)
    parts = [part for part in read_parts(path) if len(part.faces)]
    if not parts:
        raise UserError(
            f"the mesh {str(path)!r} has no faces: give a triangle mesh, or a point cloud to a "
            "point-cloud prior"
        )
    mesh = _drop_bad_vertices(merged(parts), path)
    vertices = mesh.vertices if len(mesh.vertices) else np.zeros((1, 3))  # no face is usable
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    half = (high - low).max() / 2
    centred = (vertices - (low + high) / 2) / (half or 1.0)
    if not half > 0 or not face_areas(mesh._replace(vertices=centred)).sum() > 0:
        said = "all its faces have zero area, or a NaN or infinity"
        raise UserError(f"the mesh {str(path)!r} has no surface: {said}")
    return mesh._replace(vertices=scale * centred @ rotation.T)


def mesh_file(path: str | Path) -> Path:
    """Return the path of a mesh, or of the bundled one of that name, without reading it.

    Raises:
        UserError: the file is missing or its format is unknown.
    """
    path = existing_file(find_mesh(path), "mesh", [mesh.name for mesh in ASSETS.glob("*.glb")])
    _extension(path)
    return path


def find_mesh(path: str | Path) -> Path:
    """Return the bundled mesh if ``path`` is its bare name and not a file itself, else ``path``."""
    bundled = ASSETS / Path(path).name
    is_bare = str(path) == bundled.name and not Path(path).exists()
    return bundled if is_bare and bundled.is_file() else Path(path)


def read_parts(path: Path) -> list[Mesh]:
    """Read the parts of a mesh file, transformed by its scene graph, in the file's axes; parts that
    consist of points have no faces.

    Raises:
        UserError: the format is unknown, or the file is damaged or too large (``side_files.py``).
    """
    extension = _extension(path)
    if extension in GLTF_FORMATS:
        return read_gltf(path)
    with reading(path, "mesh") as path:
        return (_of_ply if extension == "ply" else _by_trimesh)(path, Budget(path))


def mesh_formats() -> set[str]:
    """Return the extensions of the supported formats, without dots."""
    from trimesh.exchange.load import mesh_formats as of_trimesh

    return of_trimesh() | set(GLTF_FORMATS)


def _extension(path: Path) -> str:
    extension = path.suffix.lower().lstrip(".")
    # trimesh takes a second of processor time to import
    if extension not in GLTF_FORMATS and extension not in mesh_formats():
        raise unknown(f"mesh format of {str(path)!r}:", extension, mesh_formats())
    return extension


def _drop_bad_vertices(mesh: Mesh, path: Path) -> Mesh:
    """Remove faces with a vertex that isn't finite, and vertices that no face uses."""
    finite = _finite(mesh.vertices, "vertices", "dropped", path)
    keep_face = finite[mesh.faces].all(axis=1)
    used, faces = np.unique(mesh.faces[keep_face], return_inverse=True)
    rows = dict.fromkeys(("vertices", "uv", "vertex_colors"), used)
    rows |= dict.fromkeys(("face_colors", "tile_index"), keep_face)
    found = {name: getattr(mesh, name) for name in rows}
    kept = {name: x if x is None else x[rows[name]] for name, x in found.items()}
    return mesh._replace(faces=faces.reshape(-1, 3), **kept)


def _finite(values: np.ndarray, what: str, done: str, path: Path) -> Bool[np.ndarray, " N"]:
    """Return which rows are finite; log the others, or raise UserError if they are many."""
    finite = np.isfinite(values).all(axis=1)
    said = f"{(~finite).sum()} of {len(finite)} {what} of {str(path)!r} aren't finite"
    if (~finite).sum() > MAX_NON_FINITE * len(finite):
        raise UserError(f"{said} (at most 5 % may be): export the mesh again")
    if not finite.all():
        log.warning("%s: %s", said, done)
    return finite


def pose_rotation(extension: str, up: str, front: Optional[str]) -> np.ndarray:
    """Return the rotation (3, 3) from the file's axes to front = +x, up = +z."""
    up = ("+z" if extension in Z_UP_FORMATS else "+y") if up == "auto" else up
    if up not in AXES:
        raise unknown("up axis", up, ["auto", *AXES])
    front = "+" + "xyz"[("xyz".index(up[1]) + 1) % 3] if front is None else front
    if front not in AXES:
        raise unknown("front axis", front, AXES)
    if front[1] == up[1]:
        found = f"up is {up}, front is {front}"
        raise UserError(f"the front of a mesh can't lie along its up axis: {found}")
    return np.stack([AXES[front], np.cross(AXES[up], AXES[front]), AXES[up]])


def _of_ply(path: Path, budget: Budget) -> list[Mesh]:
    """Return a part for each texture; points have no faces."""
    table = PlyTable(path, faces=True)
    require(table.has(MEANS), f"its vertices have no {', '.join(MEANS)}")
    vertices, faces = table.doubles(MEANS), table.faces
    found = [faces[name] for name in INDICES if name in faces]
    corners = found[0] if found else Lists(*np.zeros((2, 0)))
    triangles, polygons = _triangles(corners)
    budget.spend_geometry(len(vertices), len(triangles))
    indices = corners.values.astype(np.int64)
    known = (indices >= 0) & (indices < len(vertices)) & (indices == corners.values)
    said = f"it is damaged: a face names a vertex beyond the last of {len(vertices)}"
    require(known.all(), said)
    mesh = Mesh(vertices, indices[triangles])
    if table.has(COLORS):
        colors = unit_colors(table[COLORS], table.types[COLORS[0]])
        finite = _finite(colors, "colours", "they become grey", path)
        colors = np.where(finite[:, None], colors, np.float32(GREY))
        mesh = mesh._replace(vertex_colors=colors)
    elif all(name in faces for name in COLORS):
        colors = np.stack([faces[name].values for name in COLORS], axis=1)
        full = 255 if colors.max(initial=0) > 1 else 1
        mesh = mesh._replace(face_colors=unit_rgb(colors[polygons] / full))
    uv, of_corners = None, faces.get(OF_CORNERS)
    of_vertices = [names for names in COORDINATES if table.has(names)]
    if of_corners is not None and (of_corners.lengths == 2 * corners.lengths).all():
        uv = of_corners.values.reshape(-1, 2)
    elif of_vertices:
        uv = table.doubles(of_vertices[0])[indices]
    if uv is None or not len(triangles):
        return [mesh]
    uv = np.nan_to_num(uv).clip(-LARGEST_UV, LARGEST_UV).astype(np.float32)
    numbers = np.zeros(len(corners.lengths))
    numbers = faces[TEXTURE_NUMBER].values if TEXTURE_NUMBER in faces else numbers
    return _textured(mesh, table, triangles, indices, uv, numbers[polygons], budget)


def _triangles(corners: Lists) -> tuple[Int[np.ndarray, "T 3"], Int[np.ndarray, " T"]]:
    """Divide polygons into fans; return the triangles' corners among all, and their polygons."""
    lengths = corners.lengths.astype(np.int64)
    counts = np.maximum(lengths - 2, 0)
    polygons = np.repeat(np.arange(len(lengths)), counts)
    first = np.repeat(np.cumsum(lengths) - lengths, counts)
    second = first + 1 + np.arange(len(polygons)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([first, second, second + 1], axis=1), polygons


def _textured(
    mesh: Mesh,
    table: PlyTable,
    triangles: Int[np.ndarray, "T 3"],
    indices: Int[np.ndarray, " C"],
    uv: Float[np.ndarray, "C 2"],
    numbers: Float[np.ndarray, " T"],
    budget: Budget,
) -> list[Mesh]:
    """Return a part per texture, divided at seams; triangles without one keep their colours."""
    path, files = table.path, SideFiles(table.path, budget)
    said = [text for text in table.comments if text.lower().startswith(TEXTURE_FILE.lower())]
    names = [text[len(TEXTURE_FILE) :].strip() for text in said]
    if not names:
        said = "%s has texture coordinates but names no texture, which isn't shown: add the line "
        remedy = "'comment %sNAME.png' to its header, or save the mesh as GLB"
        log.warning(said + remedy, path, TEXTURE_FILE)
    parts = []
    for number in np.unique(numbers):
        rows = numbers == number
        name = names[int(number)] if 0 <= number < len(names) else None
        content = None if name is None else files.read(name)
        if content is None:
            colors = None if mesh.face_colors is None else mesh.face_colors[rows]
            parts.append(mesh._replace(faces=mesh.faces[rows], face_colors=colors))
            continue
        corners = triangles[rows].ravel()
        keys = np.column_stack([indices[corners], uv[corners]])
        _, kept, places = np.unique(keys, axis=0, return_index=True, return_inverse=True)
        used, texture = corners[kept], decode_texture(content, repr(name[:80]), budget)
        vertices, faces = mesh.vertices[indices[used]], places.reshape(-1, 3)
        parts.append(Mesh(vertices, faces, uv=uv[used], texture=texture))
    return parts


def _by_trimesh(path: Path, budget: Budget) -> list[Mesh]:
    import trimesh

    files, content = _Resolver(path, budget), path.read_bytes()
    if path.suffix.lower() == ".obj":
        content = files.with_libraries(_plain_obj(utf8(content)))
    elif path.suffix.lower() == ".stl":
        content = _exact_stl(content)
    kind = path.suffix.lower().lstrip(".")
    try:
        options = {"file_type": kind, "resolver": files, "process": False}
        scene = trimesh.load_scene(io.BytesIO(content), **options)
    finally:  # what was refused is the reason of what trimesh raises
        if files.refused:
            raise files.refused
    if path.suffix.lower() == ".off":
        colors = _off_colors(content.decode("utf-8-sig", errors="replace"), path)
        if colors is not None:
            (geometry,) = scene.geometry.values()
            geometry.visual.vertex_colors = colors
    parts = []
    for node in scene.graph.nodes_geometry:
        world, name = scene.graph[node]
        geometry = scene.geometry[name]
        if len(getattr(geometry, "vertices", ())):
            vertices = np.array(geometry.vertices, dtype=np.float64)
            faces = np.asarray(getattr(geometry, "faces", np.zeros((0, 3))), dtype=np.int64)
            budget.spend_geometry(len(vertices), len(faces))
            usual = vertices.shape[1:] == faces.shape[1:] == (3,)
            known = not len(faces) or faces.min() >= 0 and faces.max() < len(vertices)
            said = f"it is damaged: a face names a vertex beyond the last of {len(vertices)}"
            require(usual and known, said)
            part = _colored(Mesh(vertices, faces), geometry, files)
            if not np.array_equal(world, np.eye(4)):
                part = part._replace(vertices=part.vertices @ world[:3, :3].T + world[:3, 3])
            of_vertices = [len(x) for x in (part.uv, part.vertex_colors) if x is not None]
            of_faces = [] if part.face_colors is None else [len(part.face_colors)]
            usual = {*of_vertices} <= {len(part.vertices)} and {*of_faces} <= {len(part.faces)}
            require(usual, "it is damaged: its colours don't fit its vertices or faces")
            parts.append(part)
    return parts


def _plain_obj(data: bytes) -> bytes:
    """Return an OBJ whose faces count from the first vertex, after checking each line: trimesh
    counts relative numbers from the last vertex, ignores lines that it doesn't know, stops at words
    that are no numbers (NumPy 1.26), and cuts all numbers into rows of the first one's width.
    """
    counts, lines, widths = dict.fromkeys(OBJ_NUMBERS, 0), [], set()

    def absolute(number: bytes, count: int) -> bytes:
        if not number.startswith(b"-"):
            return number
        require(int(number) >= -count, f"a face names number {int(number)} of {count} vertices")
        return b"%d" % (count + 1 + int(number))

    text = data.replace(b"\\\r\n", b"").replace(b"\\\n", b"")
    for place, line in enumerate(text.split(b"\n"), 1):
        kind, *words = line.split() or [b""]
        kind = kind.lower()
        if kind[:1] in (b"v", b"f") and kind != b"vp":
            usual = len(words) in OBJ_NUMBERS.get(kind, ()) or kind == b"f" and len(words) > 2
            usual = usual and all(map((CORNER if kind == b"f" else NUMBER).fullmatch, words))
            shown = repr(line[:80].decode(errors="replace"))
            require(usual, f"line {place} is no vertex or face: {shown}")
            if kind == b"f" and b"-" in line:
                corners = (zip(x.split(b"/"), counts.values(), strict=False) for x in words)
                words = [b"/".join(absolute(*x) for x in corner) for corner in corners]
            elif kind in counts:
                counts[kind] += 1
                widths |= {len(words)} if kind == b"v" else set()
            line = b" ".join([kind, *words])
        lines.append(line)
    require(len(widths) < 2 or widths == {3, 6}, "its vertices have different numbers of values")
    return b"\n".join(lines)


def _exact_stl(data: bytes) -> bytes:
    """Return a binary STL without what follows its last triangle, and an STL of text as it is."""
    if b"facet" in data[:1024] or b"endsolid" in data[:1024]:
        return data
    size = 84 + 50 * int.from_bytes(data[80:84], "little")
    said = f"it is truncated or damaged: {size} bytes were expected, not {len(data)}"
    require(len(data) >= size, said)
    return data[:size]


def _off_colors(text: str, path: Path) -> Optional[np.ndarray]:
    """Return the colours of an OFF file's vertices, from 0 to 1 or 255, as bytes, since trimesh
    doesn't read them; None if not every vertex has one. Logs a warning for others.
    """
    words = (line.partition("#")[0].split() for line in text.splitlines())
    (kind, *counts), *lines = filter(None, words)
    (vertices, faces, *_), *lines = [counts, *lines] if counts else lines
    rows, polygons = lines[: int(vertices)], lines[int(vertices) :][: int(faces)]
    try:
        colors = np.array([row[3:6] for row in rows], float).reshape(len(rows), 3)
    except ValueError:  # of other lengths, or no numbers
        colors = np.array([np.nan])
    usual = kind.upper() in ("OFF", "COFF") and np.isfinite(colors).all()
    has_more = "C" in kind.upper() or kind.upper() == "OFF" and any(len(row) > 3 for row in rows)
    of_faces = any(len(polygon) > int(polygon[0]) + 1 for polygon in polygons)
    if of_faces or has_more and not usual:
        said = "%s: the colours of its %s aren't read; convert it to PLY to keep them"
        log.warning(said, path, "faces" if of_faces else "vertices")
    if not usual:
        return None
    return (colors * (255 if colors.max() <= 1 else 1)).round().clip(0, 255).astype(np.uint8)


class _Resolver:
    """Reads a mesh's files for trimesh, which catches what is raised; the first is ``refused``."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.budget, self.file_name = budget, path.name
        self.refused: Optional[Unreadable] = None
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
                open_texture(content, repr(name[:80]))
        except Unreadable as error:
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


def _colored(part: Mesh, geometry: Any, files: _Resolver) -> Mesh:
    """Return the part with the colours of trimesh's geometry: a texture is multiplied by the
    material's colour, unless that is black, as programs write it that don't multiply.
    """
    visual = geometry.visual
    if not len(part.faces):
        colors = getattr(geometry, "colors", None)
        usual = colors is not None and len(colors) == len(part.vertices)
        return part._replace(vertex_colors=unit_rgb(colors)) if usual else part
    if visual.kind == "vertex":
        return part._replace(vertex_colors=unit_rgb(visual.vertex_colors))
    if visual.kind == "face":
        return part._replace(face_colors=unit_rgb(visual.face_colors))
    if visual.kind != "texture":
        return part
    material = visual.material
    image = getattr(material, "image", getattr(material, "baseColorTexture", None))
    # trimesh makes a grey image for an OBJ with coordinates and no material: one without a format
    texture = None if getattr(image, "format", None) is None else files.picture(image)
    linear = hasattr(material, "baseColorFactor")
    tint = getattr(material, "baseColorFactor" if linear else "diffuse", None)
    if tint is not None and tuple(np.asarray(tint)[:3]) != UNSET_COLOR:
        tint = unit_rgb(np.asarray(tint)[None])[0]
        tint = linear_to_srgb(tint) if linear else tint
        if texture is None or tint.any():
            part = part._replace(vertex_colors=np.broadcast_to(tint, part.vertices.shape))
    if texture is None or visual.uv is None:
        return part
    uv = np.nan_to_num(np.asarray(visual.uv, dtype=np.float32)[:, :2])
    return part._replace(uv=uv.clip(-LARGEST_UV, LARGEST_UV), texture=texture)
