"""Triangle meshes of PLY files: polygons of any and of mixed numbers of corners, colours of
vertices or faces, and texture coordinates of vertices (Blender) or of the corners of faces
(MeshLab).

A PLY has no standard for textures: their names are in comments ``TextureFile``, which Blender
doesn't write."""

import logging
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..formats.ply import COLORS, MEANS, read_comments, unit_colors
from ..formats.ply_table import Lists, PlyTable, read_faces
from .gltf import LARGEST_UV
from .mesh import GREY, MAX_NON_FINITE, Mesh, unit_rgb
from .side_files import Budget, SideFiles, decode_texture, fail

INDICES = ("vertex_indices", "vertex_index")
COORDINATES = (("s", "t"), ("u", "v"), ("texture_u", "texture_v"))
"""Of vertices, by the names that programs give them."""
OF_CORNERS, TEXTURE_NUMBER, TEXTURE_FILE = "texcoord", "texnumber", "TextureFile "

log = logging.getLogger(__name__)


def read_ply_mesh(path: Path) -> list[Mesh]:
    """Read the parts of a PLY, one for each texture; points have no faces.

    Raises:
        UserError: the file is damaged or exceeds its budget.
    """
    budget, table, faces = Budget(path), PlyTable.read(path), read_faces(path)
    if missing := [name for name in MEANS if name not in table]:
        fail(path, f"its vertices have no {', '.join(missing)}")
    vertices = table.doubles(MEANS)
    corners = next((faces[name] for name in INDICES if name in faces), Lists(*np.zeros((2, 0))))
    triangles, polygons = _triangles(corners)
    budget.spend_geometry(len(vertices), len(triangles))
    known = (corners.values >= 0) & (corners.values < len(vertices)) & (corners.values % 1 == 0)
    if not known.all():
        wrong = corners.values[~known][0]
        fail(path, f"it is damaged: a face names vertex {wrong:g} of {len(vertices)}")
    indices = corners.values.astype(np.int64)
    mesh = Mesh(vertices, indices[triangles])
    if all(name in table for name in COLORS):
        colors = unit_colors(table[COLORS], table.stored_type(COLORS[0]), path)
        mesh = mesh._replace(vertex_colors=_finite(colors, path))
    elif all(name in faces for name in COLORS):
        colors = np.stack([faces[name].values for name in COLORS], axis=1)
        full = 255 if colors.max(initial=0) > 1 else 1
        mesh = mesh._replace(face_colors=unit_rgb(colors[polygons] / full))
    uv = _corner_coordinates(table, faces, corners, indices)
    if uv is None or not len(triangles):
        return [mesh]
    numbers = faces[TEXTURE_NUMBER].values if TEXTURE_NUMBER in faces else np.zeros(len(polygons))
    return _textured(mesh, triangles, indices, uv, numbers[polygons], budget)


def _triangles(
    corners: Lists,
) -> tuple[Int[np.ndarray, "T 3"], Int[np.ndarray, " T"]]:
    """Divide polygons into fans; return the positions of the triangles' corners among all corners,
    and the polygon of each triangle.
    """
    lengths = corners.lengths.astype(np.int64)
    counts = np.maximum(lengths - 2, 0)
    polygons = np.repeat(np.arange(len(lengths)), counts)
    first = np.repeat(np.cumsum(lengths) - lengths, counts)
    second = first + 1 + np.arange(len(polygons)) - np.repeat(np.cumsum(counts) - counts, counts)
    return np.stack([first, second, second + 1], axis=1), polygons


def _finite(colors: Float[np.ndarray, "V 3"], path: Path) -> Float[np.ndarray, "V 3"]:
    """Return the colours with grey for those that aren't finite, if they are few."""
    finite = np.isfinite(colors).all(axis=1)
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


def _corner_coordinates(
    table: PlyTable, faces: dict[str, Lists], corners: Lists, indices: Int[np.ndarray, " C"]
) -> Optional[Float[np.ndarray, "C 2"]]:
    """Return the texture coordinates of all corners, or None."""
    of_corners = faces.get(OF_CORNERS)
    if of_corners is not None and (of_corners.lengths == 2 * corners.lengths).all():
        uv = of_corners.values.reshape(-1, 2)
    else:
        named = [names for names in COORDINATES if all(name in table for name in names)]
        if not named:
            return None
        uv = table.doubles(named[0])[indices]
    return np.nan_to_num(uv).clip(-LARGEST_UV, LARGEST_UV).astype(np.float32)


def _textured(
    mesh: Mesh,
    triangles: Int[np.ndarray, "T 3"],
    indices: Int[np.ndarray, " C"],
    uv: Float[np.ndarray, "C 2"],
    numbers: Float[np.ndarray, " T"],
    budget: Budget,
) -> list[Mesh]:
    """Return a part for each texture: the triangles with its number, with vertices divided where
    their coordinates differ. Triangles without a texture keep their colours.
    """
    path, files = budget.path, SideFiles(budget.path, budget)
    names = [
        comment[len(TEXTURE_FILE) :].strip()
        for comment in read_comments(path)
        if comment.lower().startswith(TEXTURE_FILE.lower())
    ]
    if not names:
        log.warning(
            "%s has texture coordinates but names no texture, which isn't shown: add the line "
            "'comment %sNAME.png' to its header, or save the mesh as GLB",
            path,
            TEXTURE_FILE,
        )
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
        used = corners[kept]
        parts.append(
            Mesh(
                mesh.vertices[indices[used]],
                places.reshape(-1, 3),
                uv=uv[used],
                texture=decode_texture(content, repr(name[:80]), budget),
            )
        )
    return parts
