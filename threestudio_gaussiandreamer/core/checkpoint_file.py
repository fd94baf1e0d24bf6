"""Checkpoint files. A crash while writing leaves the previous file intact; reading verifies a
checksum and runs no code from the file.

A file is the zip archive that ``torch.save`` writes, with ``sha256:<hex>`` as the archive's
comment, the hash of all bytes before the digest. ``torch.load`` can read it too."""

import glob
import hashlib
import io
import mmap
import os
import pickle
import re
import shutil
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Optional

import torch

from .errors import UserError
from .files import atomic_file, output_folder, temporary_start
from .logs import warn

_MARK = b"sha256:"
_DIGITS = 64


def save_file(path: str | os.PathLike, content: Any) -> None:
    """Write ``content`` to ``path`` atomically; an existing file is kept as ``<stem>-prev``.

    Raises:
        UserError: the disk is full or the folder can't be written; an existing file is unchanged.
    """
    path, buffer = Path(path), io.BytesIO()
    torch.save(content, buffer)
    output_folder(path.absolute().parent, f"the checkpoint {path}")
    # of processes that were killed while saving
    for stale in path.parent.glob(f"{glob.escape(temporary_start(path))}*.tmp"):
        stale.unlink(missing_ok=True)
    with atomic_file(path) as file:
        # the last two bytes of an archive without a comment are the length of the comment
        length = (len(_MARK) + _DIGITS).to_bytes(2, "little")
        marked = buffer.getvalue()[:-2] + length + _MARK
        file.write(marked + hashlib.sha256(marked).hexdigest().encode())
        _keep_previous(path)


def load_file(path: str | os.PathLike, map_location: Any = "cpu") -> Any:
    """Read what :func:`save_file` or ``torch.save`` wrote, without executing code from the file;
    raise UserError if it is missing, damaged or no checkpoint.
    """
    path = Path(os.path.expanduser(path))
    if os.path.isdir(path):
        last = path / "ckpts" / "last.ckpt"
        meant = f": did you mean {last}?" if last.is_file() else _siblings(path / "*")
        raise UserError(f"{path} is a folder, not a checkpoint{meant}")
    if not os.path.isfile(path):  # reading a FIFO would wait for a writer
        raise UserError(f"there is no checkpoint {path}{_siblings(path)}")
    try:
        _verify(path)
        content = torch.load(path, map_location=map_location, weights_only=True)
        _require_stored(content, os.path.getsize(path))
        return content
    except pickle.UnpicklingError as error:
        # the first line of torch's message advises to load the file with weights_only=False
        found = re.search(r"GLOBAL (\S+)", str(error))
        said = f"it isn't read{f': {found[1]}' if found else ''}"
        raise UserError(f"{path} holds Python objects that could run code, so {said}") from error
    except Exception as error:  # of many types for a damaged file
        said = (str(error).strip() or type(error).__name__).splitlines()[0] + _siblings(path)
        raise UserError(f"{path} isn't a checkpoint, or is damaged: {said}") from error


def _verify(path: Path) -> None:
    """Raise an exception unless the checksum of a file, or of torch.save's records, holds."""
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as content:
        covered = len(content) - _DIGITS
        if content[max(covered - len(_MARK), 0) : max(covered, 0)] != _MARK:
            with zipfile.ZipFile(file) as archive:
                damaged = archive.testzip()
                if damaged or archive.comment:
                    raise ValueError(f"the checksum of {damaged or 'the file'} doesn't match")
            return
        with memoryview(content) as view, view[:covered] as part:
            digest = hashlib.sha256(part).hexdigest()
        if digest.encode() != content[covered:]:
            raise ValueError("its checksum doesn't match")


def _require_stored(content: Any, size: int) -> None:
    """Raise ValueError if a tensor, of stride 0 for instance, is larger than its file."""
    if isinstance(content, torch.Tensor):
        if content.numel() * content.element_size() > size:
            shape = tuple(content.shape)
            raise ValueError(f"{size} bytes can't hold a tensor of the shape {shape}")
    elif isinstance(content, (Mapping, list, tuple, set)):
        for item in content.values() if isinstance(content, Mapping) else content:
            _require_stored(item, size)


def newest_readable(folder: str | os.PathLike) -> Optional[tuple[Path, int]]:
    """Return the intact checkpoint of a folder with the highest step, ``last.ckpt`` among equal
    ones, and that step; None if there is none. Damaged files are reported in the log.
    """

    def claimed_order(path: Path) -> tuple[float, bool]:
        try:  # without the checksum, which takes seconds for a large file
            content = torch.load(path, map_location="cpu", weights_only=True, mmap=True)
            return int(content["global_step"]), path.stem == "last"
        except Exception:
            return float("inf"), False  # it is reported below

    for path in sorted(Path(folder).glob("*.ckpt"), key=claimed_order, reverse=True):
        try:
            return path, load_checkpoint(path)["global_step"]
        except UserError as error:
            warn(str(error).removesuffix(_siblings(path)))  # they are checked here
    return None


def load_module_weights(path: str, module_name: Optional[str] = None) -> tuple[dict, int, int]:
    """Return the parameters of one module (its prefix removed), or all, and the checkpoint's epoch
    and step; raise UserError as :func:`load_checkpoint`, or if it has no parameters of that module.
    """
    checkpoint = load_checkpoint(path)
    state = entries_below(checkpoint["state_dict"], f"{module_name}." if module_name else "")
    if not state:
        there = sorted(checkpoint["state_dict"])
        raise UserError(f"{path} has no parameters of {module_name!r}; it has {there}")
    return state, checkpoint["epoch"], checkpoint["global_step"]


def entries_below(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the entries whose names begin with ``prefix``, without it."""
    return {name[len(prefix) :]: x for name, x in state.items() if name.startswith(prefix)}


def load_checkpoint(path: str | os.PathLike, map_location: Any = "cpu") -> dict:
    """Read a training checkpoint by :func:`load_file`: a dict with ``state_dict``, ``epoch``,
    ``global_step`` and more; raise UserError if one of these is missing or of a wrong type.
    """
    found = load_file(path, map_location)
    known = found if isinstance(found, dict) else {}
    kinds = {"epoch": int, "global_step": int, "state_dict": Mapping}
    wrong = [key for key, kind in kinds.items() if not isinstance(known.get(key), kind)]
    for name, value in () if wrong else known["state_dict"].items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            wrong.append(f"tensor {name!r}")
    if wrong:
        raise UserError(f"{path} isn't a training checkpoint: no valid {', '.join(wrong[:3])}")
    return known


def _keep_previous(path: Path) -> None:
    kept = path.with_name(f"{path.stem}-prev{path.suffix}")
    # both names are hard links to one file where the last save was killed after os.replace below,
    # and renaming one of them to the other would do nothing
    if not path.exists() or kept.exists() and kept.samefile(path):
        return
    temporary = kept.with_name(f".{kept.name}.tmp")
    temporary.unlink(missing_ok=True)
    try:
        os.link(path, temporary)
    except OSError:  # a file system without hard links
        shutil.copyfile(path, temporary)
    os.replace(temporary, kept)


def _siblings(path: Path) -> str:
    others = sorted(str(other) for other in path.parent.glob("*.ckpt") if other != path)
    return f"; others in this folder, not checked: {', '.join(others)}" if others else ""
