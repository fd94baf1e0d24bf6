"""Coordinate axes of Gaussians, named by the axis that points up, and rotations between them.

=======  =====  =======  ==========================================================================
up       right  front    used by
=======  =====  =======  ==========================================================================
``z``    +y     +x       this package's world
``y``    +x     +z       SPZ, glTF, OBJ
``-y``   +x     -z       PLY files of 3D Gaussian splatting and their viewers: the axes of a camera
                         (x right, y down, z forward) that looks at the front
=======  =====  =======  ==========================================================================

"Right" is the right-hand side of a viewer who looks at the front."""

from functools import cache

import numpy as np
import torch
from jaxtyping import Float

from ..core.errors import UserError
from .gaussians import Gaussians
from .sh import MAX_DEGREE, sh_basis

WORLD_UP = "z"
VIEWER_UP = "-y"
AXES = {
    "y": np.eye(3),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""Rotation to the axes (right, up, front), by the name of the axis that is up."""
FRONTS = {"y": "+z", "-y": "-z", "z": "+x"}


def rotation_between(up: str, other: str) -> Float[np.ndarray, "3 3"]:
    """Return the rotation of coordinates with the axis ``up`` up to those with ``other`` up."""
    return AXES[other].T @ AXES[up]


def rotate(gaussians: Gaussians, rotation: Float[np.ndarray, "3 3"]) -> Gaussians:
    """Rotate Gaussians (arrays) about the origin, or mirror them, by an orthogonal matrix:
    positions, quaternions and harmonics.

    Raises:
        UserError: spherical harmonics above degree 3.
    """
    with np.errstate(invalid="ignore", over="ignore"):  # rows with NaN or infinity are allowed
        return gaussians._replace(
            means=(gaussians.means @ rotation.T).astype(np.float32),
            quats=_rotate_quats(gaussians.quats, rotation),
            sh=_rotate_sh(gaussians.sh, rotation),
        )


def placed(gaussians: Gaussians, world: Float[np.ndarray, "4 4"], name: str) -> Gaussians:
    """Transform Gaussians by the matrix of their node in a scene.

    Args:
        name: the file, for the message.

    Raises:
        UserError: the matrix isn't a rotation, a translation and one scale.
    """
    if np.array_equal(world, np.eye(4)):
        return gaussians
    scale = np.linalg.norm(world[:3, :3], axis=0).mean()
    rotation = world[:3, :3] / (scale if 0 < scale < np.inf else 1)
    close = np.allclose(rotation.T @ rotation, np.eye(3), atol=1e-4)  # rounding
    if not close or np.linalg.det(rotation) < 0 or not np.isfinite(world).all():
        raise UserError(f"{name}: a node mirrors its Gaussians or scales them by different factors")
    turned = rotate(gaussians, rotation)
    return turned._replace(
        means=(turned.means * scale + world[:3, 3]).astype(np.float32),
        log_scales=(turned.log_scales + np.log(scale)).astype(np.float32),
    )


def _rotate_quats(
    quats: Float[np.ndarray, "N 4"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N 4"]:
    """Multiply quaternions (wxyz) from the left by that of the rotation; of a mirroring, by that
    of its negative, since an ellipsoid doesn't change when it is mirrored at its centre.
    """
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation * np.linalg.det(rotation)).as_quat()
    product = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (quats @ product.T).astype(np.float32)


def _rotate_sh(
    sh: Float[np.ndarray, "N K 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N K 3"]:
    """Rotate harmonics: the result has in direction R d the value of ``sh`` in direction d."""
    degree = round(sh.shape[1] ** 0.5) - 1
    if degree > MAX_DEGREE:
        raise UserError(
            f"spherical harmonics of degree {degree} can't be converted to other axes: degree "
            f"{MAX_DEGREE} is the highest"
        )
    if degree == 0:
        return sh
    matrix = _sh_rotation(tuple(map(tuple, rotation.tolist())), degree)
    return np.einsum("lk,nkc->nlc", matrix, sh).astype(np.float32)


@cache
def _sh_rotation(rotation: tuple[tuple[float, ...], ...], degree: int) -> Float[np.ndarray, "K K"]:
    """Compute the matrix that rotates coefficients, by least squares over random directions, which
    is exact: rotated harmonics of a degree are linear combinations of that degree's.
    """
    directions = np.random.default_rng(0).normal(size=(64, 3))
    rotated, original = (
        torch.stack(sh_basis(torch.from_numpy(dirs), degree), 1).numpy()
        for dirs in (directions @ np.array(rotation).T, directions)
    )
    return np.linalg.pinv(rotated) @ original
