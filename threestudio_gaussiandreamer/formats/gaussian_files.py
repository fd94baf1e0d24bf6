"""Files of Gaussians, PLY or SPZ by the name's ending, with their axes and what was pruned.

Every file says in which axes it is: a PLY in a comment of its header, SPZ by definition (y up).
A PLY without that comment, as other programs write it, is read as -y up, the axes of 3D Gaussian
splatting and its viewers; those are also what is written unless another axis is asked for."""

import re
from pathlib import Path
from typing import NamedTuple, Optional

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..gaussians.axes import AXES, VIEWER_UP, WORLD_UP, rotate, rotation_between
from ..gaussians.gaussians import Gaussians, drawable
from .ply import gaussians_size, read_comments, read_gaussians, write_gaussians
from .spz import SPZ_UP, read_spz, read_spz_comment, spz_arrays, spz_bytes, write_spz

UP, PRUNED = "up:", "pruned to the likeness, dB:"
DEFAULT_UP = {".ply": VIEWER_UP, ".spz": SPZ_UP}
"""The axis that is up in a file that doesn't say, by format; the keys are all formats."""


class StoredCloud(NamedTuple):
    """Gaussians and what their file says about them."""

    gaussians: Gaussians
    """As arrays."""
    up: str = WORLD_UP
    """The axis that is up, a key of ``AXES``."""
    pruned_to: Optional[float] = None
    """PSNR to the original cloud, dB, that it has been pruned to."""

    def in_axes(self, up: str) -> "StoredCloud":
        """Return the same cloud in coordinates with another axis up."""
        if up == self.up:
            return self
        rotation = rotation_between(self.up, up)
        return self._replace(gaussians=rotate(self.gaussians, rotation), up=up)


def require_format(name: str, option: str) -> str:
    """Return the ending of a file name that a format is known for.

    Raises:
        UserError: another one; ``option`` is what the name was given for.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in DEFAULT_UP:
        raise UserError(
            f"{option}: expected the name of a {' or '.join(DEFAULT_UP)} file, got {name!r}"
        )
    return suffix


def read_cloud(path: str, *, up: Optional[str] = None) -> StoredCloud:
    """Read the Gaussians of a file that can be drawn.

    Args:
        up: the file's axis that is up, whatever the file says.

    Raises:
        UserError: no such file, of an unknown format, or damaged.
    """
    file = existing_file(path, "file of Gaussians")
    require_format(file.name, "IN")
    stored = read_stored(file, up=up)
    return stored._replace(gaussians=drawable(stored.gaussians, str(file)))


def read_stored(file: Path, *, up: Optional[str] = None) -> StoredCloud:
    """Read all Gaussians of a file, also those that can't be drawn: as SPZ if that is its name's
    ending, otherwise as PLY; see :func:`read_cloud`.
    """
    if file.suffix.lower() == ".spz":
        gaussians, notes = read_spz(file), read_spz_comment(file).split("; ")
    else:
        gaussians, notes = read_gaussians(file, allow_non_finite=True), read_comments(file)
    if up is not None and up not in AXES:
        raise unknown("axis", up, AXES)
    up = up or stated_up(notes) or DEFAULT_UP.get(file.suffix.lower(), VIEWER_UP)
    return StoredCloud(gaussians, up, _number(_note(notes, PRUNED)))


def stated_up(notes: list[str]) -> Optional[str]:
    """Return the axis that is up by a file's comments; None where they don't say."""
    stated = _note(notes, UP)
    return stated if stated in AXES else None


def ply_up(path: Path) -> str:
    """Return the axis that is up in a PLY of Gaussians."""
    return stated_up(read_comments(path)) or VIEWER_UP


def _note(notes: list[str], key: str) -> str:
    """Return what the last note of this kind says; empty where there is none."""
    return next(
        (note.removeprefix(key).strip() for note in reversed(notes) if note.startswith(key)), ""
    )


def _number(text: str) -> Optional[float]:
    """Parse a number of a note, which any program may have written."""
    return float(text) if re.fullmatch(r"\d{1,4}(\.\d{1,9})?", text) else None


def write_cloud(path: str, cloud: StoredCloud, suffix: Optional[str] = None) -> None:
    """Write a cloud: PLY in its own axes, SPZ in those of the format.

    Args:
        suffix: ``.ply`` or ``.spz``; by default that of the name.

    Raises:
        UserError: an unknown format, harmonics that it can't hold, or the file can't be written.
    """
    if (suffix or require_format(path, "OUT")) == ".ply":
        write_gaussians(path, cloud.gaussians, ply_notes(cloud))
    else:
        write_spz(path, cloud.in_axes(SPZ_UP).gaussians, comment=spz_note(cloud))


def ply_notes(cloud: StoredCloud) -> list[str]:
    """Return the comments that a PLY keeps about a cloud."""
    return [f"{UP} {cloud.up}", *filter(None, [spz_note(cloud)])]


def spz_note(cloud: StoredCloud) -> str:
    """Return the comment that an SPZ file keeps about a cloud; its axes need none."""
    return "" if cloud.pruned_to is None else f"{PRUNED} {cloud.pruned_to:.6g}"


def file_size(cloud: StoredCloud, suffix: str) -> int:
    """Return the size in bytes of the file that :func:`write_cloud` makes."""
    if suffix == ".spz":
        return len(spz_bytes(cloud.in_axes(SPZ_UP).gaussians, comment=spz_note(cloud)))
    return gaussians_size(*cloud.gaussians.sh.shape[:2], ply_notes(cloud))


def as_stored(cloud: StoredCloud, suffix: str) -> StoredCloud:
    """Return the cloud as it is read from a file of this format; SPZ changes the order too."""
    if suffix == ".ply":
        return cloud
    packed = spz_bytes(cloud.in_axes(SPZ_UP).gaussians)
    return cloud._replace(gaussians=spz_arrays(packed), up=SPZ_UP).in_axes(cloud.up)
