"""Read poses of SMPL's joints from files: axis-angle rotations (NPZ, NPY), or BVH.

* NPZ with ``poses`` (F, 3 J), as AMASS has them, or with ``global_orient`` (F, 3) and ``body_pose``
  (F, 63 or 69), as smplx's arguments; the frames' dimension may be missing;
* NPY with (3 J,), (F, 3 J), (J, 3) or (F, J, 3);
* BVH, see ``bvh.py``.

J is 22, 24, 52 or 55 joints in the order of SMPL, SMPL-H or SMPL-X, of which the first 22 are used.
y is up, but in files with AMASS's frame rate, where z is."""

import math
from pathlib import Path

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..formats.array_files import read_arrays
from .body_pose import pose_of_positions, pose_of_rotations
from .bvh import read_bvh
from .makehuman import Body
from .skeleton import BODY_JOINTS

TO_BODY = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
}
"""Rotation about x from a file's axes to the body's, by the file's axis that is up."""
BODY_UP = "y"
AMASS_UP = "z"
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate")
"""Arrays that AMASS's files have."""
JOINT_COUNTS = (22, 24, 52, 55)
SUFFIXES = (".bvh", ".npz", ".npy")
EXPECTED = (
    "axis-angle rotations were expected: (frames, 3 x joints) or (frames, joints, 3) of "
    f"{', '.join(map(str, JOINT_COUNTS[:-1]))} or {JOINT_COUNTS[-1]} joints"
)


def read_pose(
    path: str, body: Body, *, frame: int = 0, up: str = "auto"
) -> Float[np.ndarray, "22 3 3"]:
    """Return one frame of a pose file as a pose of the body.

    Args:
        up: the file's axis that is up: "y", "z", "-y", or "auto".

    Raises:
        UserError: the file is missing, of another format, damaged, not finite, or has no such
            frame.
    """
    file = existing_file(path, "pose file")
    suffix = file.suffix.lower()
    if suffix not in SUFFIXES:
        raise unknown(f"format of the pose file {path!r}:", suffix, SUFFIXES)
    if suffix == ".bvh":
        pose, stated = pose_of_positions(body, read_bvh(file, frame)), BODY_UP
    else:
        local, stated = read_axis_angles(file, frame)
        pose = pose_of_rotations(body, local)
    if not np.isfinite(pose).all():
        raise UserError(f"pose file {path!r} has rotations in frame {frame} that are too large")
    return TO_BODY[stated if up == "auto" else up] @ pose


def read_axis_angles(path: Path, frame: int) -> tuple[Float[np.ndarray, "22 3 3"], str]:
    """Return the rotations of one frame, and the axis that is up."""
    from scipy.spatial.transform import Rotation

    required = ["poses"] if path.suffix.lower() == ".npy" else []
    names = ("poses", "global_orient", "body_pose", *FRAME_RATES)
    arrays = read_arrays(path, "pose file", required, names)
    angles = _frames(_rotations(arrays, path), path)
    if frame >= len(angles):
        raise UserError(
            f"frame: pose file {str(path)!r} has {len(angles)} frames, numbered from 0; there is "
            f"no {frame}"
        )
    chosen = np.asarray(angles[frame, :BODY_JOINTS], np.float64)
    if not np.isfinite(chosen).all():
        raise UserError(
            f"pose file {str(path)!r} has rotations that are NaN or infinite in frame {frame}"
        )
    up = AMASS_UP if any(name in arrays for name in FRAME_RATES) else BODY_UP
    return Rotation.from_rotvec(chosen).as_matrix(), up


def _rotations(arrays: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Return the array of all rotations, in any of the layouts."""
    if "poses" in arrays:
        return arrays["poses"]
    if "body_pose" not in arrays:
        raise UserError(
            f"pose file {str(path)!r} has neither an array 'poses' nor 'body_pose': {EXPECTED}"
        )
    flat = _flat(arrays["body_pose"])
    root = _rows(arrays["global_orient"]) if "global_orient" in arrays else np.zeros((len(flat), 3))
    if root.shape != (len(flat), 3):
        raise UserError(
            f"pose file {str(path)!r} has body_pose {arrays['body_pose'].shape} and global_orient "
            f"{arrays['global_orient'].shape}: {EXPECTED}"
        )
    return np.concatenate([root, flat], axis=1)


def _flat(values: np.ndarray) -> np.ndarray:
    """Reshape (3 J,), (J, 3), (F, 3 J) or (F, J, 3) to (frames, 3 J)."""
    return values.reshape(1, -1) if values.ndim == 2 and values.shape[1] == 3 else _rows(values)


def _rows(values: np.ndarray) -> np.ndarray:
    """Reshape (N,), (F, N) or (F, ...) to (frames, N)."""
    if values.ndim < 2:
        return values.reshape(1, -1)
    return values.reshape(len(values), math.prod(values.shape[1:]))


def _frames(values: np.ndarray, path: Path) -> Float[np.ndarray, "F J 3"]:
    """Convert any of the layouts to (frames, joints, 3)."""
    if values.dtype.kind in "fiu" and values.size and values.shape[-2:] != (3, 3):
        flat = _flat(values)
        if flat.shape[1] in [3 * count for count in JOINT_COUNTS]:
            return flat.reshape(len(flat), -1, 3)
    hint = "" if values.shape[-2:] != (3, 3) else "; matrices aren't read"
    raise UserError(
        f"pose file {str(path)!r} holds an array {values.shape} of {values.dtype}: {EXPECTED}{hint}"
    )
