"""Triangle meshes from files, in the world's pose: z up, front = +x, centred, longest half side =
``scale``.

Shared by the mesh prior (points on the surface) and the ray caster (target images); both ask
:func:`surface_colors`. Colours are those a viewer shows without lights: texture times vertex
colour, else vertex, face or material colour, else grey 0.5. All values are display values (sRGB) in
[0, 1]; a texture's alpha channel is ignored.

``up="auto"`` is +y for glTF, OBJ and other modelling formats and +z for PLY, STL and OFF. The front
is the axis after the up axis (x -> y -> z -> x), which is +z for y-up files, as glTF says, and +x
for z-up ones."""

import logging
from pathlib import Path
from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Bool, Float, Int

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..gaussians.grow import distinct
from .check import check_mesh_file

Z_UP_FORMATS = ("ply", "stl", "off", "xyz")
GREY = 0.5
MAX_NON_FINITE = 0.05
MOST_TEXELS = 8192 * 8192
"""A larger texture, which a small file may unpack to, fills the memory."""
# What trimesh writes where a material names no colour; multiplying by it would only darken the
# texture.
UNSET_COLOR = (102, 102, 102)
AXES = {
    sign + name: (1 if sign == "+" else -1) * np.eye(3)[i]
    for sign in "+-"
    for i, name in enumerate("xyz")
}

ASSETS = Path(__file__).parents[1] / "assets"

log = logging.getLogger(__name__)


class Mesh(NamedTuple):
    """A triangle mesh and what colours it; see :func:`surface_colors` for how they combine."""

    vertices: Float[np.ndarray, "V 3"]
    """float64, world units."""
    faces: Int[np.ndarray, "F 3"]
    uv: Optional[Float[np.ndarray, "V 2"]] = None
    """v grows upwards in the texture; outside [0, 1] the texture repeats."""
    texture: Optional[Float[np.ndarray, "H W 3"]] = None
    """float32 in [0, 1], row 0 on top; an atlas where the file has several textures."""
    vertex_colors: Optional[Float[np.ndarray, "V 3"]] = None
    face_colors: Optional[Float[np.ndarray, "F 3"]] = None
    tiles: Optional[Int[np.ndarray, "F 4"]] = None
    """Each face's rectangle (left, top, width, height) of the atlas in texels; width 0 = not
    textured. None = all of it.
    """

    @property
    def has_colors(self) -> bool:
        """Whether the file said anything about colour."""
        return any(
            colors is not None for colors in (self.texture, self.vertex_colors, self.face_colors)
        )


def load_mesh(
    path: str | Path, *, scale: float = 1.0, up: str = "auto", front: Optional[str] = None
) -> Mesh:
    """Read a mesh file, merge its scene, and bring it into the world's pose.

    Args:
        path: a file that trimesh reads (GLB, glTF, OBJ, PLY, STL, OFF, ...), or the bare name of a
            bundled one.
        scale: half the longest side of the result's box, world units, > 0.
        up, front: the file's axes, "+x" ... "-z"; see the module for the defaults.

    Raises:
        UserError: missing, unreadable, unknown format, no faces, > 5 % non-finite vertices, no
            extent, bad ``up``/``front``.
    """
    path = existing_file(find_mesh(path), "mesh", bundled_meshes())
    if not scale > 0:
        raise UserError(f"the scale of a mesh must be greater than 0, not {scale}")
    rotation = _pose(_extension(path), up, front)
    mesh = _merge(_read_parts(path))
    mesh = _drop_bad_vertices(mesh, path)
    return mesh._replace(vertices=_normalise(mesh, rotation, scale, path))


def surface_colors(
    mesh: Mesh, face_index: Int[np.ndarray, " M"], barycentric: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 3"]:
    """The colour at M places on the surface, float32 in [0, 1].

    Args:
        face_index: rows of ``mesh.faces``.
        barycentric: weights of the face's three corners, each row sums to 1.
    """
    weights = barycentric.astype(np.float32)
    if mesh.texture is None:
        return _flat_colors(mesh, face_index, weights)
    colors = _texture_colors(mesh, face_index, weights)
    if mesh.vertex_colors is not None:
        colors *= _flat_colors(mesh, face_index, weights)
    return colors


def sample_surface(
    mesh: Mesh, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``count`` places uniform over the surface: points (count, 3), face_index (count,),
    barycentric (count, 3).

    Faces without area get none, and where faces repeat each other only the first does: their
      surface is there once.
    """
    areas = face_areas(mesh) * ~repeated_faces(mesh)
    face_index = generator.choice(len(areas), size=count, p=areas / areas.sum())
    # Osada et al. 2002, "Shape Distributions", eq. 1: uniform in a triangle.
    root, along = np.sqrt(generator.random(count)), generator.random(count)
    barycentric = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    points = np.einsum("mk,mkc->mc", barycentric, mesh.vertices[mesh.faces[face_index]])
    return points, face_index, barycentric


class SurfaceDistance:
    """Distances from a surface, by the nearest of ``samples`` points on it.

    Too large by about the spacing of the samples, sqrt(area / samples): some 0.5 % of the box.
    """

    def __init__(self, mesh: Mesh, *, samples: int = 200_000) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(sample_surface(mesh, samples, np.random.default_rng(0))[0])

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """The distance of each point, world units."""
        return self._tree.query(points)[0]


def face_areas(mesh: Mesh) -> Float[np.ndarray, " F"]:
    """The area of each face, world units squared."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def repeated_faces(mesh: Mesh) -> Bool[np.ndarray, " F"]:
    """Marks each face with the corners of an earlier one, whichever way round and even if the
    vertices are other copies.
    """
    _, place, _ = distinct(mesh.vertices)
    corners = np.sort(place[mesh.faces], axis=1)
    order = np.lexsort(corners.T)
    repeated = np.zeros(len(corners), bool)
    repeated[order[1:]] = (np.diff(corners[order], axis=0) == 0).all(axis=1)
    return repeated


def find_mesh(path: str | Path) -> Path:
    """The path itself, or the bundled mesh of that bare name where there is no such file."""
    bundled = ASSETS / Path(path).name
    return (
        bundled
        if str(path) == bundled.name and bundled.is_file() and not Path(path).exists()
        else Path(path)
    )


def bundled_meshes() -> list[str]:
    """The bare names of the meshes that come along."""
    return sorted(file.name for file in ASSETS.glob("*.glb"))


# Reading
# --------------------------------------------------------------------------------------------------


def _extension(path: Path) -> str:
    from trimesh.exchange.load import mesh_formats

    extension = path.suffix.lower().lstrip(".")
    if extension not in mesh_formats():
        raise unknown(f"mesh format of {str(path)!r}:", extension, mesh_formats())
    return extension


def _read_parts(path: Path) -> list[Mesh]:
    """The file's triangle meshes in their place in the scene, still in the file's pose."""
    check_mesh_file(path)
    try:
        return [
            _require_fitting(_part(geometry, path), path) for geometry in _read_geometries(path)
        ]
    except UserError:
        raise
    except (
        Exception
    ) as error:  # each of trimesh's readers fails in its own way, and some only when they are asked
        raise UserError(
            f"can't read the mesh {str(path)!r}: {type(error).__name__}: {error}"
        ) from error


def _require_fitting(part: Mesh, path: Path) -> Mesh:
    """The part itself if what colours it has a row for each vertex or face."""
    count = {
        "uv": (len(part.vertices), 2),
        "vertex_colors": (len(part.vertices), 3),
        "face_colors": (len(part.faces), 3),
    }
    for name, shape in count.items():
        if (values := getattr(part, name)) is not None and values.shape != shape:
            raise UserError(
                f"the mesh {str(path)!r} is damaged: its {name} are {values.shape}, {shape} "
                "was expected"
            )
    return part


def _read_geometries(path: Path) -> list:
    """The file's triangle meshes with their place in the scene applied."""
    import trimesh

    geometries = trimesh.load_scene(path, process=False).dump()
    meshes = [g for g in geometries if isinstance(g, trimesh.Trimesh) and len(g.faces)]
    if not meshes:
        raise UserError(
            f"the mesh {str(path)!r} has no faces: give a triangle mesh, or a point cloud to a "
            "point-cloud prior"
        )
    return meshes


def _part(geometry, path: Path) -> Mesh:
    """One trimesh geometry as a Mesh, still in the file's pose."""
    faces = np.asarray(geometry.faces, dtype=np.int64)
    vertices = np.array(geometry.vertices, dtype=np.float64)
    if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.shape[1:] != (3,):
        raise UserError(
            f"the mesh {str(path)!r} is damaged: vertices {vertices.shape} and faces "
            f"{faces.shape} aren't of three numbers"
        )
    if faces.min() < 0 or faces.max() >= len(vertices):
        raise UserError(
            f"the mesh {str(path)!r} is damaged: a face names vertex {faces.max()} of "
            f"{len(vertices)}"
        )
    part = Mesh(vertices=vertices, faces=faces)
    visual = geometry.visual
    if visual.kind == "texture":
        return _with_material(part, visual)
    if visual.kind == "vertex":
        return part._replace(vertex_colors=_vertex_colors(geometry, path))
    if visual.kind == "face":
        return part._replace(face_colors=_rgb(visual.face_colors))
    return part


def _vertex_colors(geometry, path: Path) -> np.ndarray:
    """The vertices' colours, grey where a PLY's own aren't finite: trimesh makes those black
    without a word.
    """
    colors = _rgb(geometry.visual.vertex_colors)
    stored = geometry.metadata.get("_ply_raw", {}).get("vertex", {"properties": ()})
    names = [name for name in ("red", "green", "blue") if name in stored["properties"]]
    finite = np.all(
        [np.isfinite(stored["data"][name]).reshape(-1) for name in names], axis=0
    ) | np.zeros(len(colors), bool)
    if (bad := int((~finite).sum())) > MAX_NON_FINITE * len(finite):
        raise UserError(
            f"{bad} of {len(finite)} colours of {str(path)!r} aren't finite (at most 5 % may "
            "be): export the mesh again"
        )
    if bad:
        log.warning(
            "%d of %d colours of %s aren't finite: they become grey", bad, len(finite), path
        )
    return np.where(finite[:, None], colors, np.float32(GREY))


def _with_material(part: Mesh, visual) -> Mesh:
    """Texture tinted by the material's colour, else that colour on every vertex; COLOR_0 of glTF
    multiplies both.
    """
    image, tint = _image_and_tint(visual.material)
    colors = visual.vertex_attributes.get("color") if hasattr(visual, "vertex_attributes") else None
    if colors is not None and len(colors) == len(part.vertices):
        part = part._replace(vertex_colors=_rgb(colors))
    if image is not None and visual.uv is not None:
        if image.width * image.height > MOST_TEXELS:
            raise UserError(
                f"a texture of {image.width} x {image.height} is too large: {MOST_TEXELS} "
                "texels are the most"
            )
        texture = np.asarray(image.convert("RGB"), dtype=np.float32) / 255
        uv = np.nan_to_num(np.asarray(visual.uv, dtype=np.float32)[:, :2])
        return part._replace(uv=uv, texture=texture if tint is None else texture * tint)
    if tint is not None:
        own = 1 if part.vertex_colors is None else part.vertex_colors
        return part._replace(vertex_colors=np.broadcast_to(tint * own, part.vertices.shape))
    return part


def _image_and_tint(material) -> tuple:
    """The colour image (or None) and the material's colour (3,) in [0, 1] (or None) of either kind
    of trimesh material.
    """
    if hasattr(material, "baseColorFactor"):
        image, tint = material.baseColorTexture, material.baseColorFactor
    else:
        image, tint = getattr(material, "image", None), getattr(material, "diffuse", None)
    if tint is None or tuple(np.asarray(tint)[:3]) == UNSET_COLOR:
        return image, None
    tint = _rgb(np.asarray(tint)[None])[0]
    return image, _linear_to_srgb(tint) if hasattr(material, "baseColorFactor") else tint


def _linear_to_srgb(linear: np.ndarray) -> np.ndarray:
    """IEC 61966-2-1; glTF's factors are linear, its textures are not."""
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.power(linear, 1 / 2.4) - 0.055
    ).astype(np.float32)


def _rgb(colors: np.ndarray) -> np.ndarray:
    """(n, 3+) uint8 or float colours as float32 RGB in [0, 1]; a colour that isn't finite becomes
    grey.
    """
    colors = np.asarray(colors)[:, :3]
    if colors.dtype.kind in "ui":
        return colors.astype(np.float32) / np.iinfo(colors.dtype).max
    if not (finite := np.isfinite(colors).all(axis=1)).all():
        log.warning("%d colours of the mesh aren't finite: they become grey", (~finite).sum())
    return np.where(finite[:, None], colors, GREY).clip(0, 1).astype(np.float32)


# Merging
# --------------------------------------------------------------------------------------------------


def _merge(parts: list[Mesh]) -> Mesh:
    """One mesh of several; textures go into an atlas, face colours onto corners of their own."""
    if len(parts) == 1:
        return parts[0]
    parts = [_unwelded(part) for part in parts]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    merged = Mesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate(
            [part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
        ),
    )
    if any(part.has_colors for part in parts):
        merged = merged._replace(
            vertex_colors=np.concatenate([_vertex_factor(part) for part in parts])
        )
    if any(part.texture is not None for part in parts):
        merged = merged._replace(**_atlas(parts))
    return merged


def _unwelded(part: Mesh) -> Mesh:
    """A face-coloured part with three vertices of its own for each face, coloured like the face."""
    if part.face_colors is None:
        return part
    corners = part.faces.reshape(-1)
    colors = np.repeat(part.face_colors, 3, axis=0)
    return Mesh(
        vertices=part.vertices[corners],
        faces=np.arange(len(corners)).reshape(-1, 3),
        vertex_colors=colors,
    )


def _vertex_factor(part: Mesh) -> np.ndarray:
    """What multiplies the texture (1 where nothing does), or the colour itself where there is no
    texture.
    """
    if part.vertex_colors is not None:
        return part.vertex_colors
    return np.full(part.vertices.shape, GREY if part.texture is None else 1.0, dtype=np.float32)


def _atlas(parts: list[Mesh]) -> dict[str, np.ndarray]:
    """The parts' textures below each other, and each face's rectangle; the lookup repeats inside
    the rectangle.
    """
    textures = [part.texture for part in parts if part.texture is not None]
    atlas = np.zeros(
        (sum(map(len, textures)), max(t.shape[1] for t in textures), 3), dtype=np.float32
    )
    tiles, uvs, top = [], [], 0
    for part in parts:
        height, width = (0, 0) if part.texture is None else part.texture.shape[:2]
        if height:
            atlas[top : top + height, :width] = part.texture
        tiles.append(np.tile([0, top, width, height], (len(part.faces), 1)))
        uvs.append(
            np.zeros((len(part.vertices), 2), dtype=np.float32) if part.uv is None else part.uv
        )
        top += height
    return {"texture": atlas, "tiles": np.concatenate(tiles), "uv": np.concatenate(uvs)}


# Cleaning and pose
# --------------------------------------------------------------------------------------------------


def _drop_bad_vertices(mesh: Mesh, path: Path) -> Mesh:
    """Without the faces that touch a non-finite vertex, and without vertices that no face uses."""
    finite = np.isfinite(mesh.vertices).all(axis=1)
    if (bad := int((~finite).sum())) > MAX_NON_FINITE * len(finite):
        raise UserError(
            f"{bad} of {len(finite)} vertices of {str(path)!r} aren't finite (at most 5 % may "
            "be): export the mesh again"
        )
    if bad:
        log.warning("dropped %d of %d vertices of %s that aren't finite", bad, len(finite), path)
    keep_face = finite[mesh.faces].all(axis=1)
    used, faces = np.unique(mesh.faces[keep_face], return_inverse=True)
    rows = {name: getattr(mesh, name) for name in ("vertices", "uv", "vertex_colors")}
    face_rows = {name: getattr(mesh, name) for name in ("face_colors", "tiles")}
    return mesh._replace(
        faces=faces.reshape(-1, 3),
        **{name: None if value is None else value[used] for name, value in rows.items()},
        **{name: None if value is None else value[keep_face] for name, value in face_rows.items()},
    )


def _normalise(mesh: Mesh, rotation: np.ndarray, scale: float, path: Path) -> np.ndarray:
    """The vertices rotated, with the box's centre at the origin and its longest half side equal to
    ``scale``.
    """
    if not len(mesh.vertices):
        raise UserError(
            f"no face of the mesh {str(path)!r} is usable: all touch a non-finite vertex"
        )
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    half = (high - low).max() / 2
    centred = (mesh.vertices - (low + high) / 2) / (half or 1.0)
    if not half > 0 or not face_areas(mesh._replace(vertices=centred)).sum() > 0:
        raise UserError(f"the mesh {str(path)!r} has no surface: all its faces have zero area")
    return scale * centred @ rotation.T


def _pose(extension: str, up: str, front: Optional[str]) -> np.ndarray:
    """The rotation (3, 3) from the file's axes to front = +x, up = +z: its rows are front, up x
    front and up.
    """
    up = ("+z" if extension in Z_UP_FORMATS else "+y") if up == "auto" else up
    if up not in AXES:
        raise unknown("up axis", up, ["auto", *AXES])
    front = "+" + "xyz"[("xyz".index(up[1]) + 1) % 3] if front is None else front
    if front not in AXES:
        raise unknown("front axis", front, AXES)
    if front[1] == up[1]:
        raise UserError(
            f"the front of a mesh can't lie along its up axis: up is {up}, front is {front}"
        )
    return np.stack([AXES[front], np.cross(AXES[up], AXES[front]), AXES[up]])


# Colours
# --------------------------------------------------------------------------------------------------


def _flat_colors(mesh: Mesh, face_index: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Vertex colours interpolated, else face colours, else grey."""
    if mesh.vertex_colors is not None:
        return np.einsum("mk,mkc->mc", weights, mesh.vertex_colors[mesh.faces[face_index]])
    if mesh.face_colors is not None:
        return mesh.face_colors[face_index]
    return np.full((len(face_index), 3), GREY, dtype=np.float32)


def _texture_colors(mesh: Mesh, face_index: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Bilinear between texel centres, repeating inside each face's tile; 1 where a face has no
    texture.
    """
    uv = np.einsum("mk,mkc->mc", weights, mesh.uv[mesh.faces[face_index]])
    if mesh.tiles is None:
        return _bilinear(mesh.texture, uv, (0, 0, mesh.texture.shape[1], mesh.texture.shape[0]))
    colors = np.ones((len(uv), 3), dtype=np.float32)
    tiles = mesh.tiles[face_index]
    for tile in np.unique(tiles, axis=0):
        if tile[2]:
            rows = (tiles == tile).all(axis=1)
            colors[rows] = _bilinear(mesh.texture, uv[rows], tile)
    return colors


def _bilinear(texture: np.ndarray, uv: np.ndarray, tile) -> np.ndarray:
    """The texture's rectangle ``tile`` at uv (M, 2), v upwards, repeated."""
    left, top, width, height = map(int, tile)
    x = np.mod(uv[:, 0], 1) * width - 0.5
    y = np.mod(1 - uv[:, 1], 1) * height - 0.5
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]
    columns = [left + (x0.astype(np.int64) + i) % width for i in (0, 1)]
    rows = [(top + (y0.astype(np.int64) + i) % height) * texture.shape[1] for i in (0, 1)]
    texels = texture.reshape(-1, 3)
    upper, lower = (
        (1 - fx) * texels[row + columns[0]] + fx * texels[row + columns[1]] for row in rows
    )
    return (1 - fy) * upper + fy * lower
