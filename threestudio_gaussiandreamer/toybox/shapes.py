"""Primitives that the toybox's objects are made of: triangles with normals and a role.

A role says which colour a part gets ("body", "part", "accessory", or a fixed detail as "dark"). The
pattern coordinates of a vertex are (around, along) in world units of the object before it is
scaled; ``world.py`` divides them by the pattern's period."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

SEGMENTS = 20
"""Sides of a round primitive."""


class Shape(NamedTuple):
    """Triangles of one primitive."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    normals: Float[np.ndarray, "V 3"]
    """Unit length, outwards."""
    uv: Float[np.ndarray, "V 2"]
    """Distance around and along the surface."""
    role: str


def lathe(role: str, profile, center=(0, 0, 0), axis=(0, 0, 1), segments: int = SEGMENTS) -> Shape:
    """Revolve a polyline of (radius, height) pairs around ``axis`` through ``center``. Each piece
    has its own vertices and normal, so that corners are sharp."""
    profile = np.asarray(profile, float)
    step = np.diff(profile, axis=0)
    normal = np.stack([step[:, 1], -step[:, 0]], 1)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-9)
    rows = np.stack([profile[:-1], profile[1:]], 1).reshape(-1, 2)
    return _revolve(role, rows, np.repeat(normal, 2, axis=0), center, axis, segments)


def ellipsoid(role: str, center, radii, axis=(0, 0, 1), rings: int = 10) -> Shape:
    """Make an ellipsoid with half axes ``radii`` (x, y, z) before ``axis`` turns its z."""
    theta = np.linspace(0, np.pi, rings + 1)
    circle = np.stack([np.sin(theta), -np.cos(theta)], 1)
    unit = _revolve(role, circle, circle)
    radii = np.asarray(radii, float)
    normals = unit.normals / radii
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    uv = unit.uv * [radii[:2].mean(), radii[2]]
    return _placed(unit.vertices * radii, unit.faces, normals, uv, center, axis, role)


def limb(role: str, start, end, start_radius: float, end_radius: float | None = None) -> Shape:
    """Make a tapered cylinder with closed ends between two points."""
    start, end = np.asarray(start, float), np.asarray(end, float)
    length = np.linalg.norm(end - start)
    end_radius = start_radius if end_radius is None else end_radius
    profile = [(0, 0), (start_radius, 0), (end_radius, length), (0, length)]
    return lathe(role, profile, start, end - start, segments=12)


def cone(role: str, base, tip, radius: float) -> Shape:
    """Make a cone with a closed base."""
    return limb(role, base, tip, radius, 0.0)


def box(role: str, center, half, taper=(1.0, 1.0), axis=(0, 0, 1)) -> Shape:
    """Make a box with half sides ``half``; ``taper`` scales the top in x and y (0 for a roof)."""
    half = np.asarray(half, float)
    signs = np.array([[x, y, z] for z in (-1, 1) for y in (-1, 1) for x in (-1, 1)], float)
    scale = np.where(signs[:, 2:] > 0, [*taper, 1.0], 1.0)
    corners = signs * half * scale
    quads = np.array(
        [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]]
    )
    vertices = corners[quads].reshape(-1, 3)
    a, b, c, d = np.moveaxis(corners[quads], 1, 0)
    normals = np.cross(c - a, d - b)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    normals = np.repeat(normals, 4, axis=0)
    (x, y, z), (nx, ny, nz) = vertices.T, np.abs(normals.T)
    flat = nz > 0.9
    uv = np.stack([np.where(~flat & (nx > ny), y, x), np.where(flat, y, z)], 1)
    faces = (4 * np.arange(6)[:, None, None] + np.array([[0, 1, 2], [0, 2, 3]])).reshape(-1, 3)
    return _placed(vertices, faces, normals, uv, center, axis, role)


def ring(
    role: str, center, radii, thickness: float, axis=(0, 0, 1), height: float | None = None
) -> Shape:
    """Make a torus around an ellipse with half axes ``radii`` (x, y), of half height ``height``."""
    height = thickness if height is None else height
    a, b = np.meshgrid(
        np.linspace(-np.pi, np.pi, SEGMENTS + 1), np.linspace(0, 2 * np.pi, 9), indexing="ij"
    )
    around = np.stack([np.cos(a), np.sin(a)], -1)
    flat = around * (np.asarray(radii, float) + thickness * np.cos(b)[..., None])
    vertices = np.concatenate([flat, height * np.sin(b)[..., None]], -1).reshape(-1, 3)
    normals = np.concatenate([around * np.cos(b)[..., None], np.sin(b)[..., None]], -1)
    uv = np.stack([a * np.mean(radii), b * thickness], -1).reshape(-1, 2)
    faces = _grid_faces(*a.shape)
    return _placed(vertices, faces, normals.reshape(-1, 3), uv, center, axis, role)


def frame(axis) -> Float[np.ndarray, "3 3"]:
    """Return rows x', y', z' of a right-handed frame with z' = ``axis`` and x' nearest to +x."""
    z = np.asarray(axis, float) / np.linalg.norm(axis)
    near = np.array([1.0, 0, 0]) if abs(z[0]) < 0.99 else np.array([0, 0, -np.sign(z[0])])
    x = near - z * (near @ z)
    x /= np.linalg.norm(x)
    return np.stack([x, np.cross(z, x), z])


def joined(shapes: list[Shape]) -> tuple[Shape, list[str]]:
    """Join all shapes into one, and return the role of each vertex beside it."""
    starts = np.cumsum([0, *(len(shape.vertices) for shape in shapes)])
    fields = list(zip(*shapes, strict=True))
    vertices, _, normals, uv = (np.concatenate(column) for column in fields[:4])
    faces = np.concatenate([s.faces + start for s, start in zip(shapes, starts, strict=False)])
    roles = [shape.role for shape in shapes for _ in shape.vertices]
    return Shape(vertices, faces, normals, uv, ""), roles


def _revolve(role: str, rows, slopes, center=(0, 0, 0), axis=(0, 0, 1), segments=SEGMENTS) -> Shape:
    """Revolve pairs (radius, height), an array, with their normals ``slopes``."""
    angle = np.linspace(-np.pi, np.pi, segments + 1)  # a pattern's seam is at the back
    around = np.stack([np.cos(angle), np.sin(angle), np.ones_like(angle)], 1)
    vertices, normals = (
        (pairs[:, None, [0, 0, 1]] * around).reshape(-1, 3) for pairs in (rows, slopes)
    )
    along = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(rows, axis=0), axis=1))])
    widest = rows[:, 0].max()
    uv = np.stack(np.broadcast_arrays(angle[None] * widest, along[:, None]), -1)
    faces = _grid_faces(len(rows), len(angle))[:, ::-1]
    return _placed(vertices, faces, normals, uv.reshape(-1, 2), center, axis, role)


def _placed(vertices, faces, normals, uv, center, axis, role: str) -> Shape:
    """Turn the z axis to ``axis``, then move the origin to ``center``."""
    turn = frame(axis)
    return Shape(vertices @ turn + np.asarray(center), faces, normals @ turn, uv, role)


def _grid_faces(rows: int, columns: int) -> Int[np.ndarray, "F 3"]:
    """Return the triangles of a grid of vertices."""
    i, j = np.meshgrid(np.arange(rows - 1), np.arange(columns - 1), indexing="ij")
    a = (i * columns + j).reshape(-1)
    quads = np.stack([a, a + columns, a + columns + 1, a + 1], 1)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
