"""OBJ files of a surface with coloured vertices, without a material."""

import os

import numpy as np

from ..core.errors import UserError
from ..core.files import atomic_file
from ..gaussians.surface import Surface


def write_obj(path: str | os.PathLike, surface: Surface) -> None:
    """Write an OBJ with colours after the positions ("v x y z r g b"), which MeshLab, Blender and
    trimesh can read.

    Raises:
        UserError: vertices or colours aren't finite, or the file can't be written.
    """
    if not (np.isfinite(surface.vertices).all() and np.isfinite(surface.colors).all()):
        raise UserError(f"{str(path)!r} isn't written: some of its vertices hold NaN or infinity")
    with atomic_file(path) as file:
        np.savetxt(
            file,
            np.concatenate([surface.vertices, surface.colors], axis=1),
            fmt="v %.6g %.6g %.6g %.4f %.4f %.4f",
        )
        np.savetxt(file, surface.faces + 1, fmt="f %d %d %d")
