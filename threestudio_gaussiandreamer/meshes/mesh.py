"""Triangle meshes: merging, colours at points of the surface, and samples of it. Colours of files
become float32 display values in [0, 1]."""

import logging
from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from ..gaussians.grow import distinct

log = logging.getLogger(__name__)
GREY = 0.5
"""Colour of a source that has none."""
MAX_NON_FINITE = 0.05
"""Share of vertices, points or colours that may be NaN or infinite; more mean a broken file."""
REPEAT, MIRROR, CLAMP = range(3)


class Tile(NamedTuple):
    """A texture inside ``Mesh.texture``, with its wrapping and filter."""

    start: int
    """Index of its first texel in ``Mesh.texture.reshape(-1, 3)``."""
    width: int
    height: int
    wrap_u: int = REPEAT
    wrap_v: int = REPEAT
    nearest: bool = False
    """Nearest-neighbour lookup; otherwise bilinear between texel centres."""


class Mesh(NamedTuple):
    """A triangle mesh with its colours, which :func:`surface_colors` combines."""

    vertices: Float[np.ndarray, "V 3"]
    """float64, world units."""
    faces: Int[np.ndarray, "F 3"]
    uv: Optional[Float[np.ndarray, "V 2"]] = None
    """v increases upwards in the texture; the tile's wrapping applies outside [0, 1]."""
    texture: Optional[UInt8[np.ndarray, "H W 3"] | Float[np.ndarray, "H W 3"]] = None
    """Bytes, or floats in [0, 1]; row 0 at the top. With ``tiles`` it holds the texels of several
    textures one after another.
    """
    vertex_colors: Optional[Float[np.ndarray, "V 3"]] = None
    face_colors: Optional[Float[np.ndarray, "F 3"]] = None
    tiles: tuple[Tile, ...] = ()
    """The textures in ``texture``; empty if it is a single one, with repeat wrapping."""
    tile_index: Optional[Int[np.ndarray, " F"]] = None
    """The tile of each face, -1 for no texture; None means the first tile for all faces."""

    @property
    def has_colors(self) -> bool:
        """Whether the mesh has any colours."""
        found = self.texture, self.vertex_colors, self.face_colors
        return any(colors is not None for colors in found)


def merged(parts: list[Mesh]) -> Mesh:
    """Concatenate the parts to one mesh, with a tile for each combination of texture, wrapping and
    filter. Parts with face colours get three separate vertices per face, with vertex colours.
    """
    if len(parts) == 1:
        return parts[0]
    parts = [*parts]
    for index, part in enumerate(parts):
        if part.face_colors is not None:
            corners = part.faces.reshape(-1)
            faces, colors = np.arange(len(corners)), np.repeat(part.face_colors, 3, axis=0)
            vertices = part.vertices[corners]
            parts[index] = Mesh(vertices, faces.reshape(-1, 3), vertex_colors=colors)
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    faces = [part.faces + offset for part, offset in zip(parts, offsets, strict=False)]
    mesh = Mesh(np.concatenate([part.vertices for part in parts]), np.concatenate(faces))
    if any(part.has_colors for part in parts):  # those of a part with a texture multiply it
        mesh = mesh._replace(vertex_colors=np.concatenate([_vertex_colors(part) for part in parts]))
    pictures = {id(part.texture): part.texture for part in parts if part.texture is not None}
    if not pictures:
        return mesh
    sizes = [picture.size // 3 for picture in pictures.values()]
    starts = dict(zip(pictures, np.cumsum([0, *sizes]).tolist(), strict=False))
    tiles: dict[Tile, int] = {}
    numbers, coordinates = [], []
    for part in parts:
        number, uv = -1, np.zeros((len(part.vertices), 2), dtype=np.float32)
        if part.texture is not None:
            height, width = part.texture.shape[:2]
            tile = part.tiles[0] if part.tiles else Tile(0, width, height)
            tile = tile._replace(start=starts[id(part.texture)])
            number, uv = tiles.setdefault(tile, len(tiles)), part.uv
        numbers.append(number)
        coordinates.append(uv)
    return mesh._replace(
        texture=np.concatenate([picture.reshape(-1, 1, 3) for picture in pictures.values()]),
        tiles=tuple(tiles),
        tile_index=np.repeat(numbers, [len(part.faces) for part in parts]),
        uv=np.concatenate(coordinates),
    )


def _vertex_colors(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    """Return the vertex colours; by default 1 with a texture, and grey without one."""
    if mesh.vertex_colors is not None:
        return mesh.vertex_colors
    return np.full(mesh.vertices.shape, GREY if mesh.texture is None else 1.0, dtype=np.float32)


def unit_rgb(colors: Shaped[np.ndarray, "N C"]) -> Float[np.ndarray, "N 3"]:
    """Convert integer or float colours to RGB in [0, 1]; colours that aren't finite become grey."""
    colors = np.asarray(colors)[:, :3]
    if colors.dtype.kind in "ui":
        return colors.astype(np.float32) / np.iinfo(colors.dtype).max
    if not (finite := np.isfinite(colors).all(axis=1)).all():
        log.warning("%d colours of the mesh aren't finite: they become grey", (~finite).sum())
    return np.where(finite[:, None], colors, GREY).clip(0, 1).astype(np.float32)


def linear_to_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return display values by the curve of IEC 61966-2-1; negative ones stay on its line."""
    power = 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055
    return np.where(linear <= 0.0031308, 12.92 * linear, power).astype(np.float32)


def srgb_to_linear(display: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Invert :func:`linear_to_srgb` for values in [0, 1]."""
    power = ((display + 0.055) / 1.055) ** 2.4
    return np.where(display <= 0.04045, display / 12.92, power).astype(np.float32)


def surface_colors(
    mesh: Mesh, face_index: Int[np.ndarray, " M"], barycentric: Float[np.ndarray, "M 3"]
) -> Float[np.ndarray, "M 3"]:
    """Return the colours at M points of the surface, float32 in [0, 1].

    Args:
        face_index: rows of ``mesh.faces``.
        barycentric: weights of the face's three corners; each row sums to 1.
    """
    weights = barycentric.astype(np.float32)
    if mesh.texture is None:
        return _flat_colors(mesh, face_index, weights)
    colors = _texture_colors(mesh, face_index, weights)
    if mesh.vertex_colors is not None:
        colors *= _flat_colors(mesh, face_index, weights)
    return colors


def vertex_surface_colors(mesh: Mesh) -> Float[np.ndarray, "V 3"]:
    """Return the colour at each vertex, of one of its faces where they differ."""
    if not len(mesh.faces):
        return _vertex_colors(mesh._replace(texture=None))
    corner = np.zeros(len(mesh.vertices), np.int64)
    corner[mesh.faces.ravel()] = np.arange(mesh.faces.size)  # any corner of any face at this vertex
    return surface_colors(mesh, corner // 3, np.eye(3)[corner % 3])


def _flat_colors(mesh: Mesh, face_index: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return interpolated vertex colours, else face colours, else grey."""
    if mesh.vertex_colors is not None:
        return np.einsum("mk,mkc->mc", weights, mesh.vertex_colors[mesh.faces[face_index]])
    if mesh.face_colors is not None:
        return mesh.face_colors[face_index]
    return np.full((len(face_index), 3), GREY, dtype=np.float32)


def _texture_colors(mesh: Mesh, face_index: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Look up the texture of each point's face; 1 for faces without a texture."""
    uv = np.einsum("mk,mkc->mc", weights, mesh.uv[mesh.faces[face_index]])
    texels = mesh.texture.reshape(-1, 3)
    if mesh.tile_index is None:
        height, width = mesh.texture.shape[:2]
        return _looked_up(texels, uv, mesh.tiles[0] if mesh.tiles else Tile(0, width, height))
    colors = np.ones((len(uv), 3), dtype=np.float32)
    tiles = mesh.tile_index[face_index]
    for number in np.unique(tiles[tiles >= 0]):
        rows = tiles == number
        colors[rows] = _looked_up(texels, uv[rows], mesh.tiles[number])
    return colors


def _looked_up(texels: np.ndarray, uv: np.ndarray, tile: Tile) -> np.ndarray:
    """Look up the colours of ``tile`` at uv (M, 2), v upwards."""
    u, v = _wrapped(uv[:, 0], tile.wrap_u), _wrapped(1 - uv[:, 1], tile.wrap_v)
    x, y = u * tile.width - 0.5, v * tile.height - 0.5
    if tile.nearest:
        x, y = np.floor(x + 0.5), np.floor(y + 0.5)
    x0, y0 = np.floor(x), np.floor(y)
    fx, fy = (x - x0)[:, None], (y - y0)[:, None]

    def neighbour(index: np.ndarray, size: int, wrap: int) -> np.ndarray:
        index = index.astype(np.int64)
        return index % size if wrap == REPEAT else index.clip(0, size - 1)

    columns = [neighbour(x, tile.width, tile.wrap_u) for x in (x0, x0 + 1)]
    rows = [neighbour(y, tile.height, tile.wrap_v) for y in (y0, y0 + 1)]

    def texel(index: np.ndarray) -> Float[np.ndarray, "M 3"]:
        values = texels[index].astype(np.float32)
        return values / 255 if texels.dtype == np.uint8 else values

    upper, lower = (
        (1 - fx) * texel(start + columns[0]) + fx * texel(start + columns[1])
        for start in (tile.start + row * tile.width for row in rows)
    )
    return (1 - fy) * upper + fy * lower


def _wrapped(coordinate: np.ndarray, wrap: int) -> np.ndarray:
    """Map coordinates to [0, 1] by the wrapping mode."""
    if wrap == CLAMP:
        return coordinate.clip(0, 1)
    if wrap == MIRROR:
        return 1 - np.abs(np.mod(coordinate, 2) - 1)
    return np.mod(coordinate, 1)


def sample_surface(
    mesh: Mesh, count: int, generator: np.random.Generator
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Draw ``count`` points uniformly from the surface: points (count, 3), face_index (count,) and
    barycentric (count, 3). Of duplicate faces only the first is sampled.
    """
    areas = face_areas(mesh) * ~repeated_faces(mesh)
    face_index = generator.choice(len(areas), size=count, p=areas / areas.sum())
    # Osada et al. 2002, "Shape Distributions", eq. 1: uniform in a triangle.
    root, along = np.sqrt(generator.random(count)), generator.random(count)
    barycentric = np.stack([1 - root, root * (1 - along), root * along], axis=1)
    points = np.einsum("mk,mkc->mc", barycentric, mesh.vertices[mesh.faces[face_index]])
    return points, face_index, barycentric


class SurfaceDistance:
    """Computes distances from a surface as those to the nearest of 200,000 points on it:
    overestimated by at most about their spacing, some 0.5 % of the box.
    """

    def __init__(self, mesh: Mesh) -> None:
        from scipy.spatial import cKDTree

        self._tree = cKDTree(sample_surface(mesh, 200_000, np.random.default_rng(0))[0])

    def __call__(self, points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, " N"]:
        """Return the distance of each point, world units."""
        return self._tree.query(points)[0]


def face_areas(mesh: Mesh) -> Float[np.ndarray, " F"]:
    """Return the area of each face, world units squared."""
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces], 1, 0)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def repeated_faces(mesh: Mesh) -> Bool[np.ndarray, " F"]:
    """Return which faces have the same corner positions as an earlier one, in any order."""
    _, place, _ = distinct(mesh.vertices)
    corners = np.sort(place[mesh.faces], axis=1)
    order = np.lexsort(corners.T)
    repeated = np.zeros(len(corners), bool)
    repeated[order[1:]] = (np.diff(corners[order], axis=0) == 0).all(axis=1)
    return repeated
