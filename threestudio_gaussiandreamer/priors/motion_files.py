"""Read the output of a text-to-motion model: joint positions, texts and lengths.

* MDM's ``results.npy``, a pickled dict, of which no code is run, or an NPZ, with ``motion``
  (S, J, 3, F), and optionally ``text`` (S,) strings and ``lengths`` (S,) frames;
* NPY with (S, J, 3, F), or one motion as (J, 3, F) or (F, J, 3).

J is 22 (HumanML3D) or 24 joints in SMPL's order; metres, y up, as HumanML3D has them.
"""

from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError
from ..core.files import existing_file
from ..formats.array_files import read_arrays

JOINT_COUNTS = (22, 24)
EXPECTED = "arrays (samples, 22 or 24 joints, 3, frames) were expected"


class Motions(NamedTuple):
    """Sequences of joint positions."""

    positions: Float[np.ndarray, "S F J 3"]
    """Metres, y up."""
    texts: Optional[list[str]]
    lengths: list[int]
    """Number of valid frames of each sample; later frames are padding."""


def read_motions(path: str) -> Motions:
    """Return the motions of an NPZ or NPY file.

    Raises:
        UserError: missing, pickled, of another layout, without frames, or not finite; the message
            says what to do.
    """
    file = existing_file(path, "motion file")
    arrays = read_arrays(file, "motion file", ["motion"], ["text", "lengths"])
    positions = _sample_frame_joint(arrays["motion"], path)
    lengths = _lengths(arrays.get("lengths"), positions, path)
    texts = None if "text" not in arrays else [str(text) for text in np.atleast_1d(arrays["text"])]
    for sample, length in zip(positions, lengths, strict=True):
        if not np.isfinite(sample[:length]).all():
            raise UserError(
                f"motion file {path!r} has positions that are NaN or infinite: make it again"
            )
    return Motions(positions, texts, lengths)


def _sample_frame_joint(motion: np.ndarray, path: str) -> Float[np.ndarray, "S F J 3"]:
    """Convert any of the layouts to (samples, frames, joints, 3)."""
    shape = motion.shape
    if motion.dtype.kind not in "fiu":
        raise UserError(f"motion file {path!r} holds {motion.dtype}, not numbers: {EXPECTED}")
    if len(shape) == 4 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion.transpose(0, 3, 1, 2)
    elif len(shape) == 3 and shape[0] in JOINT_COUNTS and shape[1] == 3:
        ordered = motion.transpose(2, 0, 1)[None]
    elif len(shape) == 3 and shape[1] in JOINT_COUNTS and shape[2] == 3:
        ordered = motion[None]
    else:
        hint = (
            " (6 numbers for a joint are rotations: MDM's HumanML3D models give positions)"
            if 6 in shape
            else ""
        )
        raise UserError(f"motion file {path!r} holds an array {shape}: {EXPECTED}{hint}")
    if not ordered.size:
        raise UserError(f"motion file {path!r} holds an array {shape}, without a frame")
    return np.ascontiguousarray(ordered, np.float64)


def _lengths(
    lengths: Optional[np.ndarray], positions: Float[np.ndarray, "S F J 3"], path: str
) -> list[int]:
    samples, frames = positions.shape[:2]
    if lengths is None:
        return [frames] * samples
    if (
        lengths.shape != (samples,)
        or lengths.dtype.kind not in "iu"
        or (lengths < 1).any()
        or (lengths > frames).any()
    ):
        raise UserError(
            f"motion file {path!r}: lengths must be {samples} whole numbers from 1 to "
            f"{frames}, got {lengths.tolist()}"
        )
    return [int(length) for length in lengths]
