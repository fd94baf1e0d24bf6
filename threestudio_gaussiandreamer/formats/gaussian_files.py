"""Clouds of Gaussians in files, PLY or SPZ by the name's ending, with the axes they are in and what
was pruned from them.

A PLY keeps the cloud's own axes and says in a comment which of them is up; SPZ demands y up, so the
cloud is turned. In a file that doesn't say, the custom of its format holds: in an SPZ file y is up,
in a PLY -y."""

import logging
import re
from math import isqrt
from pathlib import Path
from typing import NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..gaussians.gaussians import Gaussians, usable
from ..gaussians.sh import sh_basis
from .ply import gaussians_size, read_comments, read_gaussians, write_gaussians
from .spz import read_spz, read_spz_comment, spz_arrays, spz_bytes, write_spz

logger = logging.getLogger(__name__)
UP, PRUNED = "up:", "pruned to the likeness, dB:"
OUR_UP = "z"
CUSTOMARY_UP = {".ply": "-y", ".spz": "y"}
"""By format; the keys are all formats."""
AXES = {
    "y": np.eye(3),
    "-y": np.diag([1.0, -1.0, -1.0]),
    "z": np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]]),
}
"""From coordinates with this axis up to right, up, back, the axes of SPZ: ``z`` is ours (front +x),
``-y`` the custom of PLY files.
"""


class StoredCloud(NamedTuple):
    """A cloud and what its file says about it."""

    gaussians: Gaussians
    up: str = OUR_UP
    """The axis that is up, a key of ``AXES``."""
    pruned_to: Optional[float] = None
    """The PSNR to its former self, dB, that it has been pruned to."""


def require_format(name: str, option: str) -> str:
    """The ending of a file name that a format is known for.

    Raises:
        UserError: another one.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in CUSTOMARY_UP:
        raise UserError(
            f"{option}: expected the name of a {' or '.join(CUSTOMARY_UP)} file, got {name!r}"
        )
    return suffix


def read_cloud(path: str, *, up: Optional[str] = None) -> StoredCloud:
    """The Gaussians in a file that can be drawn; ``up`` overrides what the file says.

    Raises:
        UserError: no such file, of an unknown format, or damaged.
    """
    file = existing_file(path, "file of Gaussians")
    suffix = require_format(file.name, "IN")
    if suffix == ".ply":
        arrays, notes = read_gaussians(file, allow_non_finite=True), read_comments(file)
    else:
        arrays, notes = read_spz(file), read_spz_comment(file).split("; ")
    stated = _note(notes, UP)
    up = up or (stated if stated in AXES else CUSTOMARY_UP[suffix])
    if up not in AXES:
        raise unknown("axis", up, AXES)
    return StoredCloud(drawable(arrays), up, _number(_note(notes, PRUNED)))


def drawable(arrays: Gaussians) -> Gaussians:
    """The Gaussians that can be drawn; says how many can't.

    Raises:
        UserError: harmonics above degree 3, which neither the rasteriser nor SPZ has.
    """
    degree = isqrt(arrays.sh.shape[1]) - 1
    if degree > 3:
        raise UserError(f"the Gaussians have harmonics of degree {degree}; expected 0 to 3")
    keep = usable(arrays)
    if not keep.all():
        logger.warning(
            "%d of %d Gaussians hold NaN or infinity: left out", (~keep).sum(), len(keep)
        )
    return arrays.rows(keep)


def _note(notes: list[str], key: str) -> str:
    """What the last note of this kind says; empty where there is none."""
    return next(
        (note.removeprefix(key).strip() for note in reversed(notes) if note.startswith(key)), ""
    )


def _number(text: str) -> Optional[float]:
    """A number that somebody else may have written."""
    return float(text) if re.fullmatch(r"\d{1,4}(\.\d{1,9})?", text) else None


def write_cloud(path: str, cloud: StoredCloud) -> None:
    """Write a cloud in the format that the name asks for.

    Raises:
        UserError: an unknown format, values that it can't hold, or the file can't be written.
    """
    suffix = require_format(path, "OUT")
    if suffix == ".ply":
        write_gaussians(
            path, **cloud.gaussians._asdict(), comments=ply_notes(cloud.up, cloud.pruned_to)
        )
    else:
        write_spz(path, **in_axes(cloud, "y")._asdict(), comment=spz_note(cloud.pruned_to))


def ply_notes(up: str, pruned_to: Optional[float]) -> list[str]:
    """What a PLY says about a cloud in its comments."""
    return [f"{UP} {up}", *filter(None, [spz_note(pruned_to)])]


def spz_note(pruned_to: Optional[float]) -> str:
    """What an SPZ file says about a cloud; its axes go without saying."""
    return "" if pruned_to is None else f"{PRUNED} {pruned_to:.6g}"


def file_size(cloud: StoredCloud, suffix: str) -> int:
    """The bytes of the file that :func:`write_cloud` makes."""
    if suffix == ".spz":
        return len(spz_bytes(in_axes(cloud, "y"), comment=spz_note(cloud.pruned_to)))
    return gaussians_size(*cloud.gaussians.sh.shape[:2], ply_notes(cloud.up, cloud.pruned_to))


def as_stored(cloud: StoredCloud, suffix: str) -> StoredCloud:
    """The cloud as it comes back from a file of this format; in another order, maybe."""
    if suffix == ".ply":
        return cloud
    back = StoredCloud(spz_arrays(spz_bytes(in_axes(cloud, "y"))), "y")
    return cloud._replace(gaussians=in_axes(back, cloud.up))


# ---- axes ----------------------------------------------------------------------------------------


def in_axes(cloud: StoredCloud, up: str) -> Gaussians:
    """The same Gaussians in coordinates with another axis up."""
    return (
        cloud.gaussians
        if up == cloud.up
        else turned(cloud.gaussians, rotation_between(cloud.up, up))
    )


def rotation_between(up: str, other: str) -> Float[np.ndarray, "3 3"]:
    """From coordinates with the axis ``up`` up to those with ``other`` up."""
    return AXES[other].T @ AXES[up]


def turned(arrays: Gaussians, rotation: Float[np.ndarray, "3 3"]) -> Gaussians:
    """The same cloud in other axes: ``rotation`` takes its coordinates to theirs."""
    return arrays._replace(
        means=(arrays.means @ rotation.T).astype(np.float32),
        quats=_turned_quats(arrays.quats, rotation),
        sh=_turned_sh(arrays.sh, rotation),
    )


def _turned_quats(
    quats: Float[np.ndarray, "N 4"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N 4"]:
    """The product of the rotation's quaternion and these, wxyz."""
    from scipy.spatial.transform import Rotation

    x, y, z, w = Rotation.from_matrix(rotation).as_quat()
    matrix = np.array([[w, -x, -y, -z], [x, w, -z, y], [y, z, w, -x], [z, -y, x, w]])
    return (quats @ matrix.T).astype(np.float32)


def _turned_sh(
    sh: Float[np.ndarray, "N K 3"], rotation: Float[np.ndarray, "3 3"]
) -> Float[np.ndarray, "N K 3"]:
    """Harmonics that show towards R d what these showed towards d; each degree turns within itself,
    so the fit below is exact.
    """
    degree = isqrt(sh.shape[1]) - 1
    if degree == 0:
        return sh
    directions = np.random.default_rng(0).normal(size=(64, 3))
    theirs, ours = (
        torch.stack(sh_basis(torch.from_numpy(d), degree), 1).numpy()
        for d in (directions @ rotation.T, directions)
    )
    return np.einsum("lk,nkc->nlc", np.linalg.pinv(theirs) @ ours, sh).astype(np.float32)
