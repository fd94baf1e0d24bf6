"""Texture coordinates: charts by xatlas, or a grid of triangles where there are many.

xatlas takes time that grows faster than the number of faces: 1 s for 5,000 of them, 23 s for
20,000. The grid takes none: two triangles share a square cell, each a right-angled half, with a gap
that keeps their texels apart when colours are interpolated. Faces that are near each other in space
are near each other in the grid."""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

XATLAS_FACES = 5000
"""Largest number of faces that xatlas unwraps."""
PADDING = 2
"""Texels between charts."""
GAP = 3.5
"""Texels of a cell's side that aren't a triangle's: colours are interpolated within one texel, and
so the triangles of a cell share none.
"""
SMALLEST_CELL = 6
"""Texels of the side of the smallest cell."""


class Unwrapped(NamedTuple):
    """The vertices of a mesh, repeated where the texture has a seam."""

    rows: Int[np.ndarray, " U"]
    """The vertex of the mesh that each is."""
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "U 2"]
    """In [0, 1], v upwards."""


def faces_that_fit(size: int) -> int:
    """Return the number of faces for which a texture of size x size texels has room."""
    return max(XATLAS_FACES, 2 * (size // SMALLEST_CELL) ** 2)


def unwrap(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], size: int
) -> Unwrapped:
    """Unwrap a mesh to a texture of size x size texels."""
    if len(faces) <= XATLAS_FACES:
        return in_charts(vertices, faces, size)
    return in_grid(vertices, faces, size)


def in_charts(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], size: int
) -> Unwrapped:
    """Unwrap a mesh to charts of few seams."""
    import xatlas

    atlas = xatlas.Atlas()
    # scaled to a unit box, since xatlas has absolute tolerances
    extent = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    scaled = (vertices - vertices.min(axis=0)) / extent
    atlas.add_mesh(scaled.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = size, PADDING, True
    atlas.generate(pack_options=options)
    rows, index, uv = atlas[0]
    return Unwrapped(rows.astype(np.int64), index.astype(np.int64), uv.astype(np.float64))


def in_grid(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], size: int
) -> Unwrapped:
    """Unwrap a mesh to two triangles per cell of a grid; the longest edge is the hypotenuse."""
    across = math.ceil(math.sqrt(math.ceil(len(faces) / 2)))
    cell = size // across
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    turned = (longest[:, None] + [2, 0, 1]) % 3  # the right angle is opposite the longest edge
    faces = np.take_along_axis(faces, turned, axis=1)
    place = np.empty(len(faces), np.int64)
    place[_spatial_order(corners.mean(axis=1))] = np.arange(len(faces))
    first, last, leg = 0.5, cell - 0.5, cell - GAP
    lower = np.array([[first, first], [first + leg, first], [first, first + leg]])
    upper = np.array([[last, last], [last - leg, last], [last, last - leg]])
    row, column = np.divmod(place // 2, across)
    texels = np.where((place % 2 == 0)[:, None, None], lower, upper)
    texels = texels + cell * np.stack([column, row], axis=1)[:, None]
    index = np.arange(3 * len(faces)).reshape(-1, 3)
    return Unwrapped(faces.ravel(), index, texels.reshape(-1, 2) / size)


def _spatial_order(points: Float[np.ndarray, "N 3"]) -> Int[np.ndarray, " N"]:
    """Sort points along a Z-order curve of 1024 cells each way."""
    low, extent = points.min(axis=0), np.ptp(points, axis=0).max()
    cells = ((points - low) / max(extent, 1e-30) * 1023).astype(np.int64)
    code = np.zeros(len(points), np.int64)
    for bit in range(10):
        for axis in range(3):
            code |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    return np.argsort(code, kind="stable")
