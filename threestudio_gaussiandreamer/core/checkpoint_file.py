"""Checkpoint files. A crash while writing leaves the previous file intact; reading verifies a
checksum and runs no code from the file.

A file is the zip archive that ``torch.save`` writes, with ``sha256:<hex>`` as the archive's
comment, the hash of all bytes before the digest. ``torch.load`` can read it too."""

import hashlib
import io
import math
import os
import pickle
import pickletools
import re
import shutil
import zipfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Optional

import torch

from .errors import UserError
from .files import atomic_file, temporaries_of
from .logs import warn
from .options import is_whole, shown

_MARK = b"sha256:"
_COMMENT_BYTES = len(_MARK) + 64
_END_OF_ARCHIVE = b"PK\x05\x06"
_END_RECORD_BYTES = 22
_BLOCK_BYTES = 1 << 20
MAX_COUNT = 10**12
"""Largest number of steps or epochs; a larger one is taken for damage."""
SHARING = 2
"""Largest total size of the tensors, in units of the file's size: tensors may share a storage, so
the total may exceed the file.
"""

ALLOWED_CALLS = re.compile(
    r"collections (OrderedDict|Counter)|builtins (set|complex)"
    r"|torch (Size|device|\w+Storage|u?int\d+|b?float\d+\w*|bool|complex\d+)"
    r"|torch\.storage UntypedStorage|torch\.serialization _get_layout"
    r"|torch\._utils (_rebuild_tensor|_rebuild_tensor_v2|_rebuild_parameter\w*)"
)
WATCHED_MODULES = re.compile(r"torch\b|builtins\b|_codecs\b|collections\b")
"""Modules whose names are checked here; ``weights_only`` refuses names of all other modules."""
MAX_OPCODES = 10_000_000


def save_file(path: str | os.PathLike, content: Any) -> None:
    """Write ``content`` to ``path`` atomically; an existing file is kept as ``<stem>-prev``.

    Raises:
        UserError: the disk is full or the folder can't be written; an existing file is unchanged.
    """
    path = Path(path)
    buffer = io.BytesIO()
    torch.save(content, buffer)
    _prepare_folder(path)
    with atomic_file(path) as file:
        file.write(_with_checksum(buffer.getvalue()))
        _keep_previous(path)


def load_file(path: str | os.PathLike, map_location: Any = "cpu") -> Any:
    """Read what :func:`save_file` or ``torch.save`` wrote, without executing code from the file.

    Raises:
        UserError: there is no such file, or it is damaged or no checkpoint.
    """
    path = Path(os.path.expanduser(path))
    if not path.is_file():
        if (last := path / "ckpts" / "last.ckpt").is_file():
            raise UserError(
                f"{path} is the folder of a run, not a checkpoint: did you mean {last}?"
            )
        if path.is_dir():
            raise UserError(f"{path} is a folder, not a checkpoint" + _siblings(path / "*"))
        raise UserError(f"there is no checkpoint {path}" + _siblings(path))
    try:
        _verify(path)
        require_plain_archive(path)
    except FileNotFoundError as error:  # the run that writes there has replaced it
        raise UserError(f"the checkpoint {path} has just been removed{_siblings(path)}") from error
    try:
        content = torch.load(path, map_location=map_location, weights_only=True)
    except pickle.UnpicklingError as error:
        # the first line of torch's message advises to load the file with weights_only=False
        found = re.search(r"GLOBAL (\S+)", str(error))
        what = f": {found[1]}" if found else ""
        raise UserError(
            f"{path} holds Python objects that could run code when read, so it isn't read{what}"
        ) from error
    except Exception as error:  # of many types for a damaged file
        reason = (str(error).strip() or type(error).__name__).splitlines()[0]
        raise UserError(f"{path} isn't a checkpoint, or is damaged: {reason}") from error
    _require_stored(content, path)
    return content


def _require_stored(content: Any, path: Path) -> None:
    """Raise UserError if the tensors are much larger than the file.

    An expanded tensor (stride 0) announces any size with a few stored numbers; copying it to a
    contiguous tensor would exhaust the memory.
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
    """Yield every tensor in nested containers once; a container may contain itself."""
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
    """Return the path at which :func:`save_file` keeps the file that it replaces."""
    path = Path(path)
    return path.with_name(f"{path.stem}-prev{path.suffix}")


def newest_readable(folder: str | os.PathLike) -> Optional[tuple[Path, int]]:
    """Return the intact checkpoint of a folder with the highest step, and that step; None if there
    is none.

    Among equal steps ``last.ckpt`` is preferred. Damaged files are reported in the log.
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
            warn(str(error).removesuffix(_siblings(candidate)))  # they are checked here
    return None


def _claimed_step(path: Path) -> float:
    """Read the step of a checkpoint without its tensors and without verifying the checksum.

    Returns infinity if it can't be read, so that :func:`newest_readable` loads and reports that
    file first.
    """
    try:
        require_plain_archive(path)
        return int(
            torch.load(path, map_location="cpu", weights_only=True, mmap=True)["global_step"]
        )
    except Exception:  # load_checkpoint will report what is wrong with the file
        return math.inf


def load_module_weights(
    path: str,
    module_name: Optional[str] = None,
    ignore_modules: Optional[list[str]] = None,
    map_location: Any = "cpu",
) -> tuple[dict, int, int]:
    """Read the parameters of one module (its prefix removed), or of all but the ignored modules.

    Returns:
        parameters, epoch and step of the checkpoint.

    Raises:
        UserError: the file is missing, damaged or no checkpoint, or has no parameters of that
            module.
    """
    checkpoint = load_checkpoint(path, map_location)
    state = checkpoint["state_dict"]
    if module_name:
        state = entries_below(state, f"{module_name}.")
    for ignored in ignore_modules or []:
        state = {key: value for key, value in state.items() if not key.startswith(f"{ignored}.")}
    if not state:
        raise UserError(
            f"the checkpoint {path} has no parameters of {module_name!r}; it has "
            f"{sorted(checkpoint['state_dict'])}"
        )
    return state, checkpoint["epoch"], checkpoint["global_step"]


def entries_below(state: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    """Return the entries whose names begin with ``prefix``, without it."""
    return {
        name.removeprefix(prefix): value for name, value in state.items() if name.startswith(prefix)
    }


def load_checkpoint(path: str | os.PathLike, map_location: Any = "cpu") -> dict:
    """Read a training checkpoint: a dict with ``state_dict``, ``epoch``, ``global_step`` and more.

    Raises:
        UserError: as in :func:`load_file`, or one of these keys is missing or of a wrong type.
    """
    checkpoint = load_file(path, map_location)
    known = checkpoint if isinstance(checkpoint, dict) else {}
    wrong = []
    for key, kind in (("epoch", int), ("global_step", int), ("state_dict", Mapping)):
        if key not in known:
            wrong.append(f"it has no {key}")
        elif not isinstance(known[key], kind):
            wrong.append(f"its {key} is of type {type(known[key]).__name__}")
        elif kind is int and not is_count(known[key]):
            wrong.append(f"its {key} is {shown(known[key])}")
    for name, value in () if wrong else known["state_dict"].items():
        if not (isinstance(name, str) and isinstance(value, torch.Tensor)):
            wrong.append(f"{shown(name)} in its state_dict is of type {type(value).__name__}")
    if wrong:
        raise UserError(f"{path} isn't a training checkpoint: {', '.join(wrong[:3])}")
    return checkpoint


def is_count(value: Any) -> bool:
    """Return whether ``value`` is a valid number of steps or epochs."""
    return is_whole(value) and 0 <= value <= MAX_COUNT


def _prepare_folder(path: Path) -> None:
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        # temporary files of processes that were killed while saving
        for stale in temporaries_of(path):
            stale.unlink(missing_ok=True)
    except OSError as error:
        raise UserError(
            f"the folder of the checkpoint {path} can't be written: {error.strerror or error}"
        ) from error


def _with_checksum(archive: bytes) -> bytes:
    """Append the checksum to a zip archive as its comment; the archive must not have one."""
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
        digest, left = hashlib.sha256(), mark_at + len(_MARK)
        while left > 0:
            digest.update(file.read(min(_BLOCK_BYTES, left)))
            left -= _BLOCK_BYTES
    if digest.hexdigest().encode() != tail[len(_MARK) :]:
        raise UserError(
            f"the checkpoint {path} is damaged: its checksum doesn't match{_siblings(path)}"
        )


def _verify_foreign(path: Path, tail: bytes) -> None:
    """Verify a file without our checksum, as plain ``torch.save`` writes it.

    The end of the archive must be there, and each record must match its CRC-32, which
    ``torch.load`` doesn't check.
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


def _keep_previous(path: Path) -> None:
    kept = previous_of(path)
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


# ---- what reading an archive may do --------------------------------------------------------------


def require_plain_archive(path: Path) -> None:
    """Check that reading an archive of ``torch.save`` allocates no more than the file's size: its
    records are stored uncompressed, and its pickle calls only what rebuilds tensors and containers.
    torch's ``weights_only`` also allows calls such as ``bytearray(10**10)``.

    Raises:
        UserError: the file is no zip archive, its records are compressed or overlap, or its pickle
            calls a function that isn't in ``ALLOWED_CALLS``.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            _require_stored_records(archive, path)
            for record in archive.infolist():
                if record.filename.endswith("data.pkl"):
                    _require_plain_pickle(archive.read(record), path)
    except (zipfile.BadZipFile, NotImplementedError, OSError, ValueError, RuntimeError) as error:
        if isinstance(error, UserError):
            raise
        raise UserError(f"{path} isn't a checkpoint, or is damaged: {error}") from error


def _require_stored_records(archive: zipfile.ZipFile, path: Path) -> None:
    records, size = archive.infolist(), os.path.getsize(path)
    if any(record.compress_type != zipfile.ZIP_STORED for record in records):
        raise UserError(f"{path} is no checkpoint of torch.save: its records are compressed")
    if sum(record.file_size for record in records) > size:
        raise UserError(f"{path} is damaged: its records are larger than the file")


def _require_plain_pickle(content: bytes, path: Path) -> None:
    for name in _called(content):
        if WATCHED_MODULES.match(name) and not ALLOWED_CALLS.fullmatch(name):
            raise UserError(
                f"{path} calls {name.replace(' ', '.')} when it is read, which no checkpoint "
                "needs, so it isn't read"
            )


def _called(content: bytes) -> Iterator[str]:
    """Yield every global that a pickle looks up, as "module name"."""
    for count, (opcode, argument, _) in enumerate(pickletools.genops(content)):
        if opcode.name == "GLOBAL":
            yield str(argument)
        if count > MAX_OPCODES:
            raise ValueError(f"its pickle has more than {MAX_OPCODES} instructions")
