"""Load triangle meshes in the world's pose: z up, front = +x, box centred at the origin, half the
longest side of the box = ``scale``.

The mesh prior (points on the surface) and the ray caster (target images) both get colours from
:func:`~threestudio_gaussiandreamer.meshes.mesh.surface_colors`. They are unlit: texture times
vertex colour, else vertex, face or material colour, else grey 0.5. All values are display values
(sRGB) in [0, 1]; a texture's alpha channel is ignored.

``up="auto"`` is +y for glTF, OBJ and other modelling formats and +z for PLY, STL and OFF. The front
is the axis after the up axis (x -> y -> z -> x), which is +z for y-up files, as glTF says, and +x
for z-up ones."""

import logging
from pathlib import Path
from typing import Optional

import numpy as np

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from .gltf import read_gltf
from .mesh import MAX_NON_FINITE, Mesh, face_areas, merged
from .ply_mesh import read_ply_mesh
from .trimesh_reader import read_with_trimesh

GLTF_FORMATS = ("glb", "gltf")
Z_UP_FORMATS = ("ply", "stl", "off", "xyz")
AXES = {
    sign + name: (1 if sign == "+" else -1) * np.eye(3)[i]
    for sign in "+-"
    for i, name in enumerate("xyz")
}

ASSETS = Path(__file__).parents[1] / "assets"

log = logging.getLogger(__name__)


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
    if not scale > 0:
        raise UserError(f"the scale of a mesh must be greater than 0, not {scale}")
    rotation = pose_rotation(_extension(path), up, front)
    mesh = merged(_surfaces(path))
    mesh = _drop_bad_vertices(mesh, path)
    return mesh._replace(vertices=_normalise(mesh, rotation, scale, path))


def mesh_file(path: str | Path) -> Path:
    """Return the path of a mesh, or of the bundled one of that name, without reading it.

    Raises:
        UserError: the file is missing or its format is unknown.
    """
    path = existing_file(find_mesh(path), "mesh", bundled_meshes())
    _extension(path)
    return path


def find_mesh(path: str | Path) -> Path:
    """Return the bundled mesh if ``path`` is its bare name and not a file itself, else ``path``."""
    bundled = ASSETS / Path(path).name
    return (
        bundled
        if str(path) == bundled.name and bundled.is_file() and not Path(path).exists()
        else Path(path)
    )


def bundled_meshes() -> list[str]:
    """Return the bare names of the meshes in the package."""
    return sorted(file.name for file in ASSETS.glob("*.glb"))


# Reading
# --------------------------------------------------------------------------------------------------


def read_parts(path: Path) -> list[Mesh]:
    """Read the parts of a mesh file, transformed by its scene graph, in the file's axes; parts that
    consist of points have no faces.

    Raises:
        UserError: the format is unknown, or the file is damaged or too large (``side_files.py``).
    """
    extension = _extension(path)
    if extension in GLTF_FORMATS:
        return read_gltf(path)
    return read_ply_mesh(path) if extension == "ply" else read_with_trimesh(path)


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


def _surfaces(path: Path) -> list[Mesh]:
    """Return the parts with faces."""
    parts = [part for part in read_parts(path) if len(part.faces)]
    if not parts:
        raise UserError(
            f"the mesh {str(path)!r} has no faces: give a triangle mesh, or a point cloud to a "
            "point-cloud prior"
        )
    return parts


# Cleaning and pose
# --------------------------------------------------------------------------------------------------


def _drop_bad_vertices(mesh: Mesh, path: Path) -> Mesh:
    """Remove faces with a vertex that isn't finite, and vertices that no face uses."""
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
    face_rows = {name: getattr(mesh, name) for name in ("face_colors", "tile_index")}
    return mesh._replace(
        faces=faces.reshape(-1, 3),
        **{name: None if value is None else value[used] for name, value in rows.items()},
        **{name: None if value is None else value[keep_face] for name, value in face_rows.items()},
    )


def _normalise(mesh: Mesh, rotation: np.ndarray, scale: float, path: Path) -> np.ndarray:
    """Return the vertices centred at the origin, scaled so that half the longest side of their box
    is ``scale``, and rotated.
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


def pose_rotation(extension: str, up: str, front: Optional[str]) -> np.ndarray:
    """Return the rotation (3, 3) from the file's axes to front = +x, up = +z: its rows are front,
    up x front and up.
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
