"""Bake renders to a texture.

Rays through the pixels' centres find the faces that are visible in each render, so hidden faces get
no colour from it. A pixel is added to the four texels around its uv coordinates, with weights
proportional to the squares of its opacity and of the cosine between the surface's normal and the
ray. Faces that no render shows take the colour of the nearest face that is shown; texels outside of
all faces take the mean of their surroundings."""

import os
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8
from tqdm import tqdm

from ..meshes.mesh import Mesh
from ..meshes.raycast import MeshCaster
from .renders import Renders

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


class PixelSamples(NamedTuple):
    """The pixels of a render that show the mesh: where on it, and their weighted colours."""

    face: Int[np.ndarray, " M"]
    uv: Float[np.ndarray, "M 2"]
    values: Float[np.ndarray, "M 4"]
    """RGB (0 to 255) times weight, and weight."""


def bake(mesh: Mesh, renders: Renders, size: int) -> UInt8[np.ndarray, "S S 3"]:
    """Return the texture, row 0 at the top, for the ``uv`` of a mesh."""
    caster, count = MeshCaster(mesh), len(renders.c2w)
    texels, faces = np.zeros((size * size, 4)), np.zeros((len(mesh.faces), 4))
    bar = tqdm(desc="texture", unit="view", total=count, disable=None, leave=False)
    with ThreadPoolExecutor(min(os.cpu_count() or 1, VIEWS_AT_ONCE)) as pool, bar:
        for first in range(0, count, VIEWS_AT_ONCE):
            views = range(first, min(first + VIEWS_AT_ONCE, count))
            found = list(pool.map(lambda view: _samples(caster, renders, view), views))
            samples = PixelSamples(*map(np.concatenate, zip(*found, strict=True)))
            _add(faces, samples.face[:, None], np.ones((len(samples.face), 1)), samples.values)
            _splat(texels, samples.uv, samples.values, size)
            bar.update(len(views))
    _paint_hidden(texels, mesh, faces, size)
    known = texels[:, 3] > KNOWN
    colors = (texels[:, :3] / np.maximum(texels[:, 3:], KNOWN)).reshape(size, size, 3)
    colors = filled(colors, known.reshape(size, size))
    return np.round(colors.clip(0, 255)).astype(np.uint8)


def _samples(caster: MeshCaster, renders: Renders, view: int) -> PixelSamples:
    """Find the place on the mesh and the weight of each pixel of a view."""
    c2w, rgba = renders.c2w[view], renders.rgba[view]
    (top, left), face, weights = caster.visible(c2w, renders.fovy, *rgba.shape[:2])
    pixels = rgba[top : top + face.shape[0], left : left + face.shape[1]]
    covered = (face >= 0) & (pixels[..., 3] >= MIN_ALPHA)
    face, weights, pixels = face[covered], weights[covered], pixels[covered].astype(np.float64)
    cosine = _cosines(caster.mesh, face, weights, c2w[:3, 3])
    weight = (pixels[:, 3] / 255) ** 2 * np.where(cosine > MIN_COSINE, cosine, 0) ** 2
    values = np.concatenate([pixels[:, :3], np.ones((len(pixels), 1))], axis=1) * weight[:, None]
    uv = np.einsum("mk,mkc->mc", weights, caster.mesh.uv[caster.mesh.faces[face]])
    return PixelSamples(face, uv, values)


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


def _splat(
    sums: Float[np.ndarray, "T 4"],
    uv: Float[np.ndarray, "M 2"],
    values: Float[np.ndarray, "M 4"],
    size: int,
) -> None:
    """Add values to the four texels around each uv, in bilinear shares."""
    texels, shares = zip(*_around(uv, size), strict=True)
    _add(sums, np.stack(texels, axis=1), np.stack(shares, axis=1), values)


def _add(
    sums: Float[np.ndarray, "T 4"],
    rows: Int[np.ndarray, "M k"],
    shares: Float[np.ndarray, "M k"],
    values: Float[np.ndarray, "M 4"],
) -> None:
    """Add ``shares`` of each of the values to k rows of the sums."""
    from scipy.sparse import csc_array

    first = np.arange(0, rows.size + 1, rows.shape[1])
    matrix = csc_array((shares.ravel(), rows.ravel(), first), shape=(len(sums), len(rows)))
    sums += matrix @ values


def _cosines(
    mesh: Mesh,
    face: Int[np.ndarray, " M"],
    weights: Float[np.ndarray, "M 3"],
    eye: Float[np.ndarray, "3"],
) -> Float[np.ndarray, " M"]:
    """Return the cosine between the outward normal and the direction to the eye."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-30)
    toward = eye - np.einsum("mk,mkc->mc", weights, corners[face])
    toward /= np.maximum(np.linalg.norm(toward, axis=1, keepdims=True), 1e-30)
    return np.einsum("mc,mc->m", normals[face], toward)


def _around(
    uv: Float[np.ndarray, "M 2"], size: int
) -> Iterator[tuple[Int[np.ndarray, " M"], Float[np.ndarray, " M"]]]:
    """Yield the four texels around each uv, and their weights in bilinear interpolation."""
    x, y = uv[:, 0] * size - 0.5, (1 - uv[:, 1]) * size - 0.5
    column, row = np.floor(x).astype(np.int64), np.floor(y).astype(np.int64)
    right, down = x - column, y - row
    for step_down, share_down in ((0, 1 - down), (1, down)):
        for step_right, share_right in ((0, 1 - right), (1, right)):
            rows, columns = (
                (row + step_down).clip(0, size - 1),
                (column + step_right).clip(0, size - 1),
            )
            yield rows * size + columns, share_down * share_right


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
