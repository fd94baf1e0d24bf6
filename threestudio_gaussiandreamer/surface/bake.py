"""Texture coordinates of a mesh, and the texture that is baked from renders.

Coordinates are charts by xatlas, or, above 5,000 faces, for which xatlas takes 1 s (20,000: 23 s),
a grid, in which two triangles share a square cell, each a right-angled half, with a gap that keeps
their texels apart when colours are interpolated.

A pixel is added to the four texels around its uv coordinates, with weights proportional to the
squares of its opacity and of the cosine between the surface's normal and the ray. Faces that no
render shows take the colour of the nearest face that is shown; texels outside of all faces take the
mean of their surroundings."""

import math
import os
import time
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from tqdm import tqdm

from ..formats.packing import morton_order
from ..meshes.mesh import Mesh
from ..meshes.raycast import MeshCaster
from .closed import Faces, Vertices, unit
from .fusion import Renders

XATLAS_FACES = 5000
"""Largest number of faces that xatlas unwraps."""
GAP = 3.5
"""Texels of a cell's side that aren't a triangle's, so that interpolation mixes no triangles."""
SMALLEST_CELL = 6
"""Texels of the side of the smallest cell."""
MIN_ALPHA = 128
"""Pixels of a lower opacity (0 to 255) aren't baked: they show what is behind the surface."""
MIN_COSINE = 0.1
"""Pixels with a smaller cosine between normal and ray have no weight."""
KNOWN = 1e-3
"""Texels of a smaller weight are filled from their surroundings."""
VIEWS_AT_ONCE = 4
"""Largest number of views whose pixels are in memory at once."""
LATTICE = 8
"""A hidden face is coloured at the points of a triangular grid, with this many intervals a side."""


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


def unwrap(vertices: Vertices, faces: Faces, size: int) -> Unwrapped:
    """Unwrap a mesh to a texture of size x size texels."""
    return (in_charts if len(faces) <= XATLAS_FACES else in_grid)(vertices, faces, size)


def in_charts(vertices: Vertices, faces: Faces, size: int) -> Unwrapped:
    """Unwrap a mesh to charts of few seams."""
    import xatlas

    atlas = xatlas.Atlas()
    # scaled to a unit box, since xatlas has absolute tolerances
    extent = max(float(np.ptp(vertices, axis=0).max()), 1e-30)
    scaled = (vertices - vertices.min(axis=0)) / extent
    atlas.add_mesh(scaled.astype(np.float32), faces.astype(np.uint32))
    options = xatlas.PackOptions()
    options.resolution, options.padding, options.bilinear = size, 2, True
    atlas.generate(pack_options=options)
    rows, index, uv = atlas[0]
    time.sleep(0.05)  # the destructor would wait for ever for a thread that isn't asleep yet
    return Unwrapped(rows.astype(np.int64), index.astype(np.int64), uv.astype(np.float64))


def in_grid(vertices: Vertices, faces: Faces, size: int) -> Unwrapped:
    """Unwrap a mesh to two triangles per cell of a grid; the longest edge is the hypotenuse."""
    across = math.ceil(math.sqrt(math.ceil(len(faces) / 2)))
    cell = size // across
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, -1, axis=1), axis=2).argmax(axis=1)
    turned = (longest[:, None] + [2, 0, 1]) % 3  # the right angle is opposite the longest edge
    faces = np.take_along_axis(faces, turned, axis=1)
    place = np.empty(len(faces), np.int64)
    place[morton_order(corners.mean(axis=1), cube=True)] = np.arange(len(faces))
    first, last, leg = 0.5, cell - 0.5, cell - GAP
    lower = np.array([[first, first], [first + leg, first], [first, first + leg]])
    upper = np.array([[last, last], [last - leg, last], [last, last - leg]])
    row, column = np.divmod(place // 2, across)
    texels = np.where((place % 2 == 0)[:, None, None], lower, upper)
    texels = texels + cell * np.stack([column, row], axis=1)[:, None]
    index = np.arange(3 * len(faces)).reshape(-1, 3)
    return Unwrapped(faces.ravel(), index, texels.reshape(-1, 2) / size)


def bake(mesh: Mesh, renders: Renders, size: int) -> UInt8[np.ndarray, "S S 3"]:
    """Return the texture, row 0 at the top, for the ``uv`` of a mesh."""
    caster, count = MeshCaster(mesh), len(renders.c2w)
    texels, faces = np.zeros((size * size, 4)), np.zeros((len(mesh.faces), 4))
    bar = tqdm(desc="texture", unit="view", total=count, disable=None, leave=False)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, VIEWS_AT_ONCE)) as pool, bar:
        for first in range(0, count, VIEWS_AT_ONCE):
            views = range(first, min(first + VIEWS_AT_ONCE, count))
            found = list(pool.map(lambda view: _samples(caster, renders, view), views))
            face, uv, values = map(np.concatenate, zip(*found, strict=True))
            _add(faces, face[:, None], np.ones((len(face), 1)), values)
            _splat(texels, uv, values, size)
            bar.update(len(views))
    _paint_hidden(texels, mesh, faces, size)
    known = texels[:, 3] > KNOWN
    colors = (texels[:, :3] / np.maximum(texels[:, 3:], KNOWN)).reshape(size, size, 3)
    colors = filled(colors, known.reshape(size, size))
    return np.round(colors.clip(0, 255)).astype(np.uint8)


def _samples(caster: MeshCaster, renders: Renders, view: int) -> tuple[np.ndarray, ...]:
    """Return face (M,), uv (M, 2), and RGB (0 to 255) times weight and weight (M, 4) of the pixels
    of a view that show the mesh.
    """
    c2w, rgba = renders.c2w[view], renders.rgba[view]
    (top, left), face, weights = caster.visible(c2w, renders.fovy, *rgba.shape[:2])
    pixels = rgba[top : top + face.shape[0], left : left + face.shape[1]]
    covered = (face >= 0) & (pixels[..., 3] >= MIN_ALPHA)
    face, weights, pixels = face[covered], weights[covered], pixels[covered].astype(np.float64)
    corners = caster.mesh.vertices[caster.mesh.faces]
    normals = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))
    toward = unit(c2w[:3, 3] - np.einsum("mk,mkc->mc", weights, corners[face]))
    cosine = np.einsum("mc,mc->m", normals[face], toward)
    weight = (pixels[:, 3] / 255) ** 2 * np.where(cosine > MIN_COSINE, cosine, 0) ** 2
    values = np.concatenate([pixels[:, :3], np.ones((len(pixels), 1))], axis=1) * weight[:, None]
    uv = np.einsum("mk,mkc->mc", weights, caster.mesh.uv[caster.mesh.faces[face]])
    return face, uv, values


def _paint_hidden(
    texels: Float[np.ndarray, "T 4"], mesh: Mesh, faces: Float[np.ndarray, "F 4"], size: int
) -> None:
    """Give faces that no render shows the mean colour of the nearest shown face."""
    from scipy.spatial import cKDTree

    shown = faces[:, 3] > KNOWN
    if shown.all() or not shown.any():
        return
    corners = mesh.faces[~shown]
    centres = mesh.vertices[mesh.faces].mean(axis=1)
    nearest = cKDTree(centres[shown]).query(centres[~shown])[1]
    means = np.append(faces[shown, :3] / faces[shown, 3:], np.ones((shown.sum(), 1)), axis=1)
    grid = [(i, j) for i in range(LATTICE + 1) for j in range(LATTICE + 1 - i)]
    weights = np.array([(i, j, LATTICE - i - j) for i, j in grid]) / LATTICE
    uv = np.einsum("gk,fkc->gfc", weights, mesh.uv[corners]).reshape(-1, 2)
    _splat(texels, uv, np.tile(2 * KNOWN * means[nearest], (len(grid), 1)), size)


def _splat(sums: np.ndarray, uv: np.ndarray, values: np.ndarray, size: int) -> None:
    """Add values to the four texels around each uv, in bilinear shares."""
    places = np.stack([(1 - uv[:, 1]) * size - 0.5, uv[:, 0] * size - 0.5], axis=1)
    first = np.floor(places).astype(np.int64)
    after = places - first
    steps = np.array([(0, 0), (0, 1), (1, 0), (1, 1)])
    rows, columns = np.moveaxis((first[:, None] + steps).clip(0, size - 1), 2, 0)
    shares = np.where(steps, after[:, None], 1 - after[:, None]).prod(axis=2)
    _add(sums, rows * size + columns, shares, values)


def _add(sums: np.ndarray, rows: np.ndarray, shares: np.ndarray, values: np.ndarray) -> None:
    """Add ``shares`` (M, k) of each of the values (M, 4) to ``rows`` (M, k) of the sums (T, 4)."""
    from scipy.sparse import csc_array

    first = np.arange(0, rows.size + 1, rows.shape[1])
    matrix = csc_array((shares.ravel(), rows.ravel(), first), shape=(len(sums), len(rows)))
    sums += matrix @ values


def filled(
    colors: Float[np.ndarray, "H W 3"], known: Bool[np.ndarray, "H W"]
) -> Float[np.ndarray, "H W 3"]:
    """Fill unknown texels with the mean of the known ones in the smallest block of 2^n x 2^n texels
    around them that has any.
    """
    if known.all() or not known.any():
        return colors
    height, width = known.shape
    pad = ((0, height % 2), (0, width % 2))
    weight = np.pad(known, pad).astype(np.float64)[..., None]
    padded = np.pad(colors, (*pad, (0, 0))) * weight
    blocks = (weight.shape[0] // 2, 2, weight.shape[1] // 2, 2)
    counts = weight.reshape(*blocks, 1).sum(axis=(1, 3))
    means = padded.reshape(*blocks, 3).sum(axis=(1, 3)) / np.maximum(counts, 1)
    coarse = filled(means, counts[..., 0] > 0)
    around = coarse.repeat(2, axis=0).repeat(2, axis=1)[:height, :width]
    return np.where(known[..., None], colors, around)
