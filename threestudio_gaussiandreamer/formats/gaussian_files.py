"""Read and write files of Gaussians of all formats, with the metadata that a file can hold.

A PLY has its axes in a comment of its header, the other formats by definition. A PLY without that
comment, as other programs write it, is read as -y up, and the same axes are written by default."""

import logging
import re
from collections.abc import Callable, Collection
from pathlib import Path
from typing import NamedTuple, Optional

from ..core.errors import UserError, unknown
from ..core.files import existing_file
from ..gaussians.axes import AXES, VIEWER_UP, WORLD_UP, rotate, rotation_between
from ..gaussians.gaussians import Gaussians, drawable
from . import ply
from .compressed_ply import is_compressed_ply, read_compressed_ply, write_compressed_ply
from .glb import GLB_UP, read_glb, write_glb, write_spz_glb
from .packing import ANTIALIASED
from .sog import SOG_UP, read_sog, write_sog
from .splat import read_ksplat, read_splat
from .spz import SPZ_UP, VERSION, read_spz, spz_arrays, spz_bytes, write_spz
from .usda import USDA_UP, read_usd, write_usda, write_usdz

logger = logging.getLogger(__name__)

UP, NERFSTUDIO_UP, PRUNED = "up:", "Vertical Axis:", "pruned to the likeness, dB:"
"""Keys of the comments in files; the last is the PSNR to the original cloud."""
RENDER_MODE = re.compile(r"splatrendermode: *(\w+)|antialiased ([01])", re.IGNORECASE)
"""``ANTIALIASED``, or Postshot's comment."""


class StoredCloud(NamedTuple):
    """Gaussians, as arrays, with the metadata of their file."""

    gaussians: Gaussians
    up: str = WORLD_UP
    """The axis that is up, a key of ``AXES``."""
    pruned_to: Optional[float] = None
    """PSNR to the original cloud, dB, after the pruning so far; None if it wasn't pruned."""
    antialiased: bool = False
    """Whether it was trained with antialiasing, and so has to be drawn with it."""

    def in_axes(self, up: str) -> "StoredCloud":
        """Return the same cloud in coordinates with another axis up."""
        if up == self.up:
            return self
        return self._replace(gaussians=rotate(self.gaussians, rotation_between(self.up, up)), up=up)


Content = tuple[Gaussians, list[str]]
"""Gaussians in the file's axes, and notes about them."""


class CloudFormat(NamedTuple):
    """How files of an extension are read and written."""

    up: str
    """The axis that is up, in formats with ``any_up`` where no note says another one."""
    read: Callable[[Path], Content]
    write: Optional[Callable[..., None]]
    """Called with the path, the Gaussians and the notes; None where a format is only read."""
    any_up: bool = False
    """Whether a file states its axes in a note."""


def _read_ply(path: Path) -> Content:
    """Read a PLY of either layout."""
    read = read_compressed_ply if is_compressed_ply(path) else ply.read_gaussians
    return read(path), ply.read_comments(path)


FORMATS = {
    ".ply": CloudFormat(VIEWER_UP, _read_ply, ply.write_gaussians, any_up=True),
    ".compressed.ply": CloudFormat(VIEWER_UP, _read_ply, write_compressed_ply, any_up=True),
    ".spz": CloudFormat(SPZ_UP, read_spz, write_spz),
    ".sog": CloudFormat(SOG_UP, read_sog, write_sog),
    ".glb": CloudFormat(GLB_UP, read_glb, write_glb),
    ".spz.glb": CloudFormat(GLB_UP, read_glb, write_spz_glb),
    ".gltf": CloudFormat(GLB_UP, read_glb, None),
    ".usda": CloudFormat(USDA_UP, read_usd, write_usda),
    ".usdz": CloudFormat(USDA_UP, read_usd, write_usdz),
    ".usdc": CloudFormat(USDA_UP, read_usd, None),
    ".usd": CloudFormat(USDA_UP, read_usd, None),
    "meta.json": CloudFormat(SOG_UP, read_sog, None),
    ".ksplat": CloudFormat(VIEWER_UP, read_ksplat, None),
    ".splat": CloudFormat(VIEWER_UP, read_splat, None),
}
"""By extension."""
READ = tuple(FORMATS)
LEVELS = ("lod-meta.json", ".lcc")
"""Scenes in levels of detail, spread over many files: SuperSplat's streamed SOG, XGRIDS' LCC."""
WRITTEN = tuple(suffix for suffix, known in FORMATS.items() if known.write)
ALWAYS_GAUSSIANS = (".spz", ".sog", ".compressed.ply", ".spz.glb")
"""Formats in which a run exports nothing but Gaussians; a PLY can be a mesh or points."""
PRUNED_FORMATS = (".ply", ".spz")
"""Formats whose size and rounding :func:`file_size` and :func:`as_stored` know."""


def suffix_of(name: str) -> str:
    """Return the longest known extension of a file name in lower case, else its last suffix."""
    known = [suffix for suffix in (*FORMATS, *LEVELS) if name.lower().endswith(suffix)]
    return max(known, key=len, default=Path(name).suffix.lower())


def conversion(name: str) -> str:
    """Return the end of a message about a file in ``LEVELS``: what converts it; else nothing."""
    tool = f"npx @playcanvas/splat-transform {name} cloud.ply"
    levels = f"; scenes in levels of detail aren't read: convert it first, with {tool}"
    return levels if suffix_of(name) in LEVELS else ""


def holds_gaussians(path: Path) -> bool:
    """Return whether a file of a run's export is of Gaussians; not of GLB and USDA, also meshes."""
    suffix = suffix_of(path.name)
    return suffix in ALWAYS_GAUSSIANS or suffix == ".ply" and ply.is_gaussian_ply(path)


def require_format(name: str, option: str, formats: Collection[str] = WRITTEN) -> str:
    """Return the extension of a file name; UserError, naming ``option``, if none of ``formats``."""
    suffix = suffix_of(name)
    if suffix not in formats:
        *others, last = formats
        expected = f"expected the name of a {', '.join(others)} or {last} file"
        raise UserError(f"{option}: {expected}, got {name!r}{conversion(name)}")
    return suffix


def read_cloud(path: str, *, up: Optional[str] = None) -> StoredCloud:
    """Read the Gaussians of a file, without those that can't be drawn.

    Args:
        up: overrides the up axis that the file states.

    Raises:
        UserError: there is no such file, its format is unknown, or it is damaged.
    """
    file = existing_file(path, "file of Gaussians")
    require_format(file.name, "IN", READ)
    stored = read_stored(file, up=up)
    return stored._replace(gaussians=drawable(stored.gaussians, str(file)))


def read_stored(file: Path, *, up: Optional[str] = None) -> StoredCloud:
    """Read all Gaussians of a file, including those that can't be drawn, as :func:`read_cloud`; as
    a PLY where the extension is unknown.
    """
    known = FORMATS.get(suffix_of(file.name), FORMATS[".ply"])
    gaussians, notes = known.read(file)
    if up is not None and up not in AXES:
        raise unknown("axis", up, AXES)
    up = up or (stated_up(notes) if known.any_up else None) or known.up
    pruned = _note(notes, PRUNED)  # the file may be from another program
    pruned_to = float(pruned) if re.fullmatch(r"\d{1,4}(\.\d{1,9})?", pruned) else None
    return StoredCloud(gaussians, up, pruned_to, _stated_mode(notes))


def stated_up(notes: list[str]) -> Optional[str]:
    """Return the up axis in a file's comments, or None if they have none that is known."""
    stated = (_note(notes, UP) or _note(notes, NERFSTUDIO_UP)).lower()
    if stated and stated not in AXES:
        said = "the up axis in the file's comment %r is none of %s: it is ignored"
        logger.warning(said, f"{UP} {stated[:40]}", ", ".join(AXES))
    return stated if stated in AXES else None


def ply_up(path: Path) -> str:
    """Return the up axis of a PLY of Gaussians, by default that of viewers."""
    return stated_up(ply.read_comments(path)) or VIEWER_UP


def is_antialiased(path: Path) -> bool:
    """Return whether a PLY of Gaussians says that they were trained with antialiasing."""
    return _stated_mode(ply.read_comments(path))


def _note(notes: list[str], key: str) -> str:
    """Return the text after ``key`` in the last note that begins with it; empty if none does."""
    return ([""] + [note.removeprefix(key).strip() for note in notes if note.startswith(key)])[-1]


def _stated_mode(notes: list[str]) -> bool:
    """Return whether the last note about it says that the cloud was trained with antialiasing."""
    modes = [found for note in notes if (found := RENDER_MODE.fullmatch(note.strip()))]
    return bool(modes) and "".join(filter(None, modes[-1].groups())).lower() in ("mip", "1")


def write_cloud(
    path: str,
    cloud: StoredCloud,
    suffix: Optional[str] = None,
    *,
    spz_version: int = VERSION,
    spz_up: str = SPZ_UP,
) -> None:
    """Write a cloud: a PLY in the cloud's axes, other formats in their own.

    Args:
        suffix: one of ``WRITTEN``; by default the extension of ``path``.
        spz_version: 3 or 4.
        spz_up: the axis that is up in an SPZ, y or, in version 4, -y.

    Raises:
        UserError: the format is unknown or without these harmonics, or the file isn't writable.
    """
    suffix = suffix or require_format(path, "OUT")
    known = FORMATS[suffix]
    options = {"version": spz_version, "up": spz_up} if suffix == ".spz" else {}
    stored = cloud if known.any_up else cloud.in_axes(options.get("up", known.up))
    known.write(path, stored.gaussians, notes_of(stored, suffix), **options)


def notes_of(cloud: StoredCloud, suffix: str) -> list[str]:
    """Return what a file of a format says about a cloud besides its Gaussians."""
    pruned = [] if cloud.pruned_to is None else [f"{PRUNED} {cloud.pruned_to:.6g}"]
    up = [f"{UP} {cloud.up}"] if FORMATS[suffix].any_up else []
    return [*up, *pruned, *([ANTIALIASED] if cloud.antialiased else [])]


def file_size(cloud: StoredCloud, suffix: str) -> int:
    """Return the size in bytes of the PLY or SPZ file that :func:`write_cloud` would write."""
    if suffix == ".spz":
        return len(spz_bytes(cloud.in_axes(SPZ_UP).gaussians, notes_of(cloud, suffix)))
    count, harmonics = cloud.gaussians.sh.shape[:2]
    properties = ply.gaussian_properties(harmonics)
    header = ply.header_bytes([("vertex", count, properties)], notes_of(cloud, suffix))
    return len(header) + 4 * len(properties) * count


def as_stored(cloud: StoredCloud, suffix: str) -> StoredCloud:
    """Return the cloud as it would be read back from a PLY or SPZ file; SPZ reorders it too."""
    if suffix == ".ply":
        return cloud
    read, _ = spz_arrays(spz_bytes(cloud.in_axes(SPZ_UP).gaussians))
    return cloud._replace(gaussians=read, up=SPZ_UP).in_axes(cloud.up)
