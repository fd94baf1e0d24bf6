"""Merge the parts of a file into one mesh."""

from typing import Any

import numpy as np

from .mesh import GREY, Mesh, Tile


def merged(parts: list[Mesh]) -> Mesh:
    """Concatenate the parts to one mesh.

    Textures are concatenated to one array with a tile for each. Parts with face colours get three
    separate vertices per face, with vertex colours.
    """
    if len(parts) == 1:
        return parts[0]
    parts = [_unwelded(part) for part in parts]
    offsets = np.cumsum([0] + [len(part.vertices) for part in parts])
    mesh = Mesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate(
            [part.faces + offset for part, offset in zip(parts, offsets[:-1], strict=True)]
        ),
    )
    if any(part.has_colors for part in parts):
        mesh = mesh._replace(vertex_colors=np.concatenate([_vertex_factor(part) for part in parts]))
    if any(part.texture is not None for part in parts):
        mesh = mesh._replace(**_textures(parts))
    return mesh


def _unwelded(part: Mesh) -> Mesh:
    """Convert face colours to vertex colours, with three separate vertices per face."""
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
    """Return the vertex colours (V, 3); by default 1 for parts with a texture, which they multiply,
    and grey for others.
    """
    if part.vertex_colors is not None:
        return part.vertex_colors
    return np.full(part.vertices.shape, GREY if part.texture is None else 1.0, dtype=np.float32)


def _textures(parts: list[Mesh]) -> dict[str, Any]:
    """Return the fields of the merged texture: each texture is stored once, with a tile for each
    combination of texture, wrapping and filter.
    """
    starts, total = {}, 0
    for part in parts:
        if part.texture is not None and id(part.texture) not in starts:
            starts[id(part.texture)] = total
            total += part.texture.size // 3
    pictures = {id(part.texture): part.texture for part in parts if part.texture is not None}
    texels = np.concatenate([pictures[key].reshape(-1, 1, 3) for key in starts])
    tiles: dict[Tile, int] = {}
    numbers = [
        -1 if part.texture is None else tiles.setdefault(_tile(part, starts), len(tiles))
        for part in parts
    ]
    return {
        "texture": texels,
        "tiles": tuple(tiles),
        "tile_index": np.repeat(numbers, [len(part.faces) for part in parts]),
        "uv": np.concatenate([_coordinates(part) for part in parts]),
    }


def _tile(part: Mesh, starts: dict[int, int]) -> Tile:
    height, width = part.texture.shape[:2]
    tile = part.tiles[0] if part.tiles else Tile(0, width, height)
    return tile._replace(start=starts[id(part.texture)])


def _coordinates(part: Mesh) -> np.ndarray:
    if part.texture is None:
        return np.zeros((len(part.vertices), 2), dtype=np.float32)
    return part.uv
