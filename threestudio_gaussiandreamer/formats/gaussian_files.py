"""Read and write files of Gaussians, PLY or SPZ by extension, with their axes and the PSNR to which
they were pruned.

The axes of a file are known: a PLY has them in a comment of its header, and SPZ is y up by
definition. A PLY without that comment, as other programs write it, is read as -y up, the axes of 3D
Gaussian splatting and its viewers. The same axes are written by default."""

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
"""The up axis of a file without a comment about it, by format; the keys are all formats."""


class StoredCloud(NamedTuple):
    """Gaussians with the metadata of their file."""

    gaussians: Gaussians
    """As arrays."""
    up: str = WORLD_UP
    """The axis that is up, a key of ``AXES``."""
    pruned_to: Optional[float] = None
    """PSNR to the original cloud, dB, after the pruning so far; None if it wasn't pruned."""

    def in_axes(self, up: str) -> "StoredCloud":
        """Return the same cloud in coordinates with another axis up."""
        if up == self.up:
            return self
        rotation = rotation_between(self.up, up)
        return self._replace(gaussians=rotate(self.gaussians, rotation), up=up)


def require_format(name: str, option: str) -> str:
    """Return the extension of a file name after checking that it is a known format.

    Args:
        option: names the option in the message.

    Raises:
        UserError: the extension is unknown.
    """
    suffix = Path(name).suffix.lower()
    if suffix not in DEFAULT_UP:
        raise UserError(
            f"{option}: expected the name of a {' or '.join(DEFAULT_UP)} file, got {name!r}"
        )
    return suffix


def read_cloud(path: str, *, up: Optional[str] = None) -> StoredCloud:
    """Read the Gaussians of a file, without those that can't be drawn.

    Args:
        up: overrides the up axis that the file states.

    Raises:
        UserError: there is no such file, its format is unknown, or it is damaged.
    """
    file = existing_file(path, "file of Gaussians")
    require_format(file.name, "IN")
    stored = read_stored(file, up=up)
    return stored._replace(gaussians=drawable(stored.gaussians, str(file)))


def read_stored(file: Path, *, up: Optional[str] = None) -> StoredCloud:
    """Read all Gaussians of a file, including those that can't be drawn; see :func:`read_cloud`.

    The file is read as SPZ if that is its extension, otherwise as PLY.
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
    """Return the up axis in a file's comments, or None if they have none."""
    stated = _note(notes, UP)
    return stated if stated in AXES else None


def ply_up(path: Path) -> str:
    """Return the up axis of a PLY of Gaussians, by default that of viewers."""
    return stated_up(read_comments(path)) or VIEWER_UP


def _note(notes: list[str], key: str) -> str:
    """Return the text after ``key`` in the last note that begins with it; empty if none does."""
    return next(
        (note.removeprefix(key).strip() for note in reversed(notes) if note.startswith(key)), ""
    )


def _number(text: str) -> Optional[float]:
    """Parse the number in a note, or return None; the file may be from another program."""
    return float(text) if re.fullmatch(r"\d{1,4}(\.\d{1,9})?", text) else None


def write_cloud(path: str, cloud: StoredCloud, suffix: Optional[str] = None) -> None:
    """Write a cloud: PLY in the cloud's axes, SPZ in those of the format.

    Args:
        suffix: ``.ply`` or ``.spz``; by default the extension of ``path``.

    Raises:
        UserError: the format is unknown or doesn't support the harmonics' degree, or the file can't
            be written.
    """
    if (suffix or require_format(path, "OUT")) == ".ply":
        write_gaussians(path, cloud.gaussians, ply_notes(cloud))
    else:
        write_spz(path, cloud.in_axes(SPZ_UP).gaussians, comment=spz_note(cloud))


def ply_notes(cloud: StoredCloud) -> list[str]:
    """Return the comments about a cloud in the header of its PLY."""
    return [f"{UP} {cloud.up}", *filter(None, [spz_note(cloud)])]


def spz_note(cloud: StoredCloud) -> str:
    """Return the comment about a cloud in its SPZ file: the PSNR of pruning, or nothing."""
    return "" if cloud.pruned_to is None else f"{PRUNED} {cloud.pruned_to:.6g}"


def file_size(cloud: StoredCloud, suffix: str) -> int:
    """Return the size in bytes of the file that :func:`write_cloud` would write."""
    if suffix == ".spz":
        return len(spz_bytes(cloud.in_axes(SPZ_UP).gaussians, comment=spz_note(cloud)))
    return gaussians_size(*cloud.gaussians.sh.shape[:2], ply_notes(cloud))


def as_stored(cloud: StoredCloud, suffix: str) -> StoredCloud:
    """Return the cloud as it would be read back from a file of this format; SPZ reorders it too."""
    if suffix == ".ply":
        return cloud
    packed = spz_bytes(cloud.in_axes(SPZ_UP).gaussians)
    return cloud._replace(gaussians=spz_arrays(packed), up=SPZ_UP).in_axes(cloud.up)
