"""Checkpoint files: written so that a crash leaves the earlier one whole, read so that damage is
noticed and no code runs.

A file is what ``torch.save`` writes, a zip archive, with ``sha256:<hex>`` of everything before it
as the archive's comment. Plain ``torch.load`` reads it."""

import hashlib
import io
import math
import os
import pickle
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from glob import escape as glob_escape
from pathlib import Path
from typing import Any, Optional

import torch

from .archive import require_plain_archive
from .errors import UserError
from .files import atomic_file
from .logs import warn
from .options import is_whole, shown

_MARK = b"sha256:"
_COMMENT_BYTES = len(_MARK) + 64
_END_OF_ARCHIVE = b"PK\x05\x06"
_END_RECORD_BYTES = 22
_BLOCK_BYTES = 1 << 20
MAX_COUNT = 10**12
"""Steps of a training run; more are a damaged number."""
SHARING = 2
"""How many times a file's size its tensors may be together, where some share their numbers."""


def save_file(path: str | os.PathLike, content: Any) -> None:
    """Write ``content`` to ``path``; the earlier file stays until the new one is whole, and then
    beside it as ``<stem>-prev``.

    Raises:
        UserError: the disk is full or the folder can't be written; the earlier file is untouched.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    _prepare_folder(path)
    with atomic_file(path) as file:
        file.write(_with_checksum(buffer.getvalue()))
        _keep_previous(path)


def load_file(path: str | os.PathLike, map_location: Any = "cpu") -> Any:
    """What :func:`save_file` or ``torch.save`` wrote; never executes code from the file.

    Raises:
        UserError: no such file, a damaged one, or one that isn't a checkpoint.
    """
    path = Path(os.path.expanduser(path))
    if not path.is_file():
        if path.is_dir():
            raise UserError(f"{path} is a folder, not a checkpoint" + _siblings(path / "*"))
        raise UserError(f"there is no checkpoint {path}" + _siblings(path))
    _verify(path)
    require_plain_archive(path)
    try:
        content = torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        # torch's own first line advises to read it all the same
        found = re.search(r"GLOBAL (\S+)", str(error))
        what = f": {found[1]}" if found else ""
        raise UserError(
            f"{path} holds Python objects that could run code when read, so it isn't read{what}"
        ) from error
    except (
        Exception
    ) as error:  # where a pickle is damaged, torch's reader of it raises what it likes
        raise UserError(f"{path} isn't a checkpoint, or is damaged: {_reason(error)}") from error
    _require_stored(content, path)
    return content


def _require_stored(content: Any, path: Path) -> None:
    """Raise UserError for tensors that repeat a few numbers to more than the file could hold:
    whoever copies them fills the memory.
    """
    size, total = os.path.getsize(path), 0
    for tensor in _tensors(content):
        total += tensor.numel() * tensor.element_size()
        if total > SHARING * size:
            raise UserError(
                f"{path} is damaged: it announces a tensor of the shape {tuple(tensor.shape)}, "
                f"which {size} bytes can't hold"
            )


def _tensors(content: Any) -> Iterator[torch.Tensor]:
    """Every tensor below ``content``, once; containers may hold themselves."""
    pending, seen = [content], set()
    while pending:
        item = pending.pop()
        if id(item) in seen:
            continue
        seen.add(id(item))
        if isinstance(item, torch.Tensor):
            yield item
        elif isinstance(item, (Mapping, list, tuple, set)):
            pending.extend(item.values() if isinstance(item, Mapping) else item)


def previous_of(path: str | os.PathLike) -> Path:
    """Where :func:`save_file` keeps the file that it replaces."""
    path = Path(path)
    return path.with_name(f"{path.stem}-prev{path.suffix}")


def newest_readable(folder: str | os.PathLike) -> Optional[tuple[Path, int]]:
    """The whole checkpoint with most steps among a folder's, of equal ones ``last.ckpt``, and its
    step; says what is damaged.
    """
    by_step = sorted(
        Path(folder).glob("*.ckpt"),
        key=lambda path: (_claimed_step(path), path.stem == "last"),
        reverse=True,
    )
    for candidate in by_step:
        try:
            return candidate, load_checkpoint(candidate)["global_step"]
        except UserError as error:
            warn(str(error))
    return None


def _claimed_step(path: Path) -> float:
    """The step that a checkpoint says it is from, its tensors unread and its checksum unchecked;
    infinity where it says none.
    """
    try:
        require_plain_archive(path)
        return int(
            torch.load(path, map_location="cpu", weights_only=True, mmap=True)["global_step"]
        )
    except Exception:  # whatever is wrong with it, who reads it whole will say
        return math.inf


def load_module_weights(
    path: str,
    module_name: Optional[str] = None,
    ignore_modules: Optional[list[str]] = None,
    map_location: Any = "cpu",
) -> tuple[dict, int, int]:
    """Parameters of one module (its prefix removed), or of all but the ignored ones, with the epoch
    and step of a checkpoint.

    Raises:
        UserError: the file is missing, damaged or no checkpoint, or has nothing for that module.
    """
    checkpoint = load_checkpoint(path, map_location)
    state = checkpoint["state_dict"]
    if module_name:
        state = {
            key.removeprefix(f"{module_name}."): value
            for key, value in state.items()
            if key.startswith(f"{module_name}.")
        }
    for ignored in ignore_modules or []:
        state = {key: value for key, value in state.items() if not key.startswith(f"{ignored}.")}
    if not state:
        raise UserError(
            f"the checkpoint {path} has no parameters of {module_name!r}; it has "
            f"{sorted(checkpoint['state_dict'])}"
        )
    return state, checkpoint["epoch"], checkpoint["global_step"]


def load_checkpoint(path: str | os.PathLike, map_location: Any = "cpu") -> dict:
    """A training checkpoint: a dict with at least ``state_dict``, ``epoch`` and ``global_step``.

    Raises:
        UserError: as :func:`load_file`, or the file holds something else.
    """
    checkpoint = load_file(path, map_location)
    missing = {"state_dict", "epoch", "global_step"} - set(
        checkpoint if isinstance(checkpoint, dict) else ()
    )
    if missing:
        raise UserError(
            f"{path} isn't a training checkpoint: it has no {', '.join(sorted(missing))}"
        )
    for key, kind in (("state_dict", Mapping), ("epoch", int), ("global_step", int)):
        if not isinstance(checkpoint[key], kind):
            raise UserError(
                f"{path} isn't a training checkpoint: its {key} is of type "
                f"{type(checkpoint[key]).__name__}"
            )
    for key in ("epoch", "global_step"):
        if not is_count(checkpoint[key]):
            raise UserError(
                f"{path} isn't a training checkpoint: its {key} is {shown(checkpoint[key])}"
            )
    for name, value in checkpoint["state_dict"].items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            raise UserError(
                f"{path} isn't a training checkpoint: {shown(name)} in its state_dict is of type "
                f"{type(value).__name__}"
            )
    return checkpoint


def is_count(value: Any) -> bool:
    """Whether ``value`` can count steps or epochs."""
    return is_whole(value) and 0 <= value <= MAX_COUNT


def _prepare_folder(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # what a process that was killed while saving has left
        for stale in path.parent.glob(f".{glob_escape(path.name)}.*.tmp"):
            stale.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(
            f"the folder of the checkpoint {path} can't be written: {error.strerror or error}"
        ) from error


def _with_checksum(archive: bytes) -> bytes:
    """A zip archive that ends without a comment, with its checksum as the comment."""
    if archive[-_END_RECORD_BYTES:][:4] != _END_OF_ARCHIVE or not archive.endswith(b"\0\0"):
        raise RuntimeError("torch.save did not write a zip archive without a comment")
    marked = archive[:-2] + _COMMENT_BYTES.to_bytes(2, "little") + _MARK
    return marked + hashlib.sha256(marked).hexdigest().encode()


def _verify(path: Path) -> None:
    with open(path, "rb") as file:
        mark_at = max(os.path.getsize(path) - _COMMENT_BYTES, 0)
        file.seek(mark_at)
        tail = file.read()
        if not tail.startswith(_MARK):
            return _verify_foreign(path, tail)
        file.seek(0)
        digest = _digest(file, mark_at + len(_MARK))
    if digest.hexdigest().encode() != tail[len(_MARK) :]:
        raise UserError(
            f"the checkpoint {path} is damaged: its checksum doesn't match{_siblings(path)}"
        )


def _verify_foreign(path: Path, tail: bytes) -> None:
    """A file of plain torch: a whole archive by its end, and each record by the checksum that torch
    writes but doesn't read.
    """
    if tail[-_END_RECORD_BYTES:][:4] != _END_OF_ARCHIVE or not tail.endswith(b"\0\0"):
        raise UserError(
            f"{path} isn't a checkpoint, or is cut short: it doesn't end as torch.save ends a "
            f"file{_siblings(path)}"
        )
    try:
        with zipfile.ZipFile(path) as archive:
            damaged = archive.testzip()
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError, RuntimeError) as error:
        raise UserError(f"the checkpoint {path} is damaged: {error}{_siblings(path)}") from error
    if damaged:
        raise UserError(
            f"the checkpoint {path} is damaged: the checksum of {damaged} doesn't "
            f"match{_siblings(path)}"
        )


def _digest(file: Any, count: int) -> Any:
    digest = hashlib.sha256()
    for start in range(0, count, _BLOCK_BYTES):
        digest.update(file.read(min(_BLOCK_BYTES, count - start)))
    return digest


def _keep_previous(path: Path) -> None:
    if not path.exists():
        return
    kept = previous_of(path)
    if kept.exists() and kept.samefile(path):
        # a kill fell after this, the last time; renaming one name of a file to another would leave
        # both
        return
    temporary = kept.with_name(f".{kept.name}.tmp")
    temporary.unlink(missing_ok=True)
    try:
        os.link(path, temporary)
    except OSError:
        # a file system without hard links
        shutil.copyfile(path, temporary)
    os.replace(temporary, kept)


def _siblings(path: Path) -> str:
    others = (
        sorted(str(other) for other in path.parent.glob("*.ckpt") if other != path)
        if path.parent.is_dir()
        else []
    )
    return f"; in the same folder there are {', '.join(others)}" if others else ""


def _reason(error: Exception) -> str:
    return str(error).strip().splitlines()[0] if str(error).strip() else type(error).__name__
