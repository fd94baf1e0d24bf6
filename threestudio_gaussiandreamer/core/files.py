"""Check paths with clear error messages, and write files atomically."""

import json
import math
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from difflib import get_close_matches
from pathlib import Path
from threading import get_ident
from typing import Any, BinaryIO

from .errors import UserError

PLACEHOLDERS = {
    (b"version https://git-lfs",): "a pointer of Git LFS, not the file itself: run `git lfs pull` "
    "where it is from, or download it again",
    (b"<!doctype html", b"<html"): "a web page, not the file itself: download it again by the link "
    "of the file, not of a page",
}
"""What downloads leave in a file's place, by its first bytes in lower case."""


def usable_path(path: str | os.PathLike, what: str, *, home: bool = False) -> Path:
    """Return a path, with ``~`` expanded if ``home``; raise UserError for NUL or a long name."""
    try:
        path = Path(path).expanduser() if home else Path(path)
        with suppress(FileNotFoundError, NotADirectoryError):
            path.stat()
    except (OSError, ValueError, RuntimeError) as error:
        raise UserError(f"{what} {_quoted(path)}: not a usable file name ({error})") from error
    return path


def existing_file(path: str | os.PathLike, kind: str, bundled: Collection[str] = ()) -> Path:
    """Return ``path`` as a :class:`Path` if it is an existing file, a ``kind`` ("PLY file").

    Raises:
        UserError: there is no such regular file, and the message lists similar names, also those of
            ``bundled`` files; or it is one of ``PLACEHOLDERS``.
    """
    path = usable_path(path, kind, home=True)
    reason = "is no regular file"
    if path.is_dir():
        has_meta = (path / "meta.json").is_file()
        hint = "; of an unpacked SOG give the meta.json in it" if has_meta else ""
        reason = f"is a folder, not a file{hint}"
    elif not path.exists():
        reason = f"does not exist; {near_names(path, bundled)}"
    if not path.is_file():
        raise UserError(f"{kind} {str(path)!r} {reason}")
    require_content(path, f"{kind} {str(path)!r}")
    return path


def require_content(path: Path, name: str) -> None:
    """Raise UserError, which names it by ``name``, if a file is one of ``PLACEHOLDERS``."""
    with suppress(OSError), open(path, "rb") as file:
        start = file.read(64).lstrip().lower()
        for starts, what in PLACEHOLDERS.items():
            if start.startswith(starts):
                raise UserError(f"{name} is {what}")


def near_names(path: Path, bundled: Collection[str] = ()) -> str:
    """Return the end of the message for a missing file: similar names, or those of a kind."""
    folder, hint = path.parent, f"there is no folder {str(path.parent)!r} either."
    if folder.is_dir():
        names = sorted(entry.name for entry in folder.iterdir() if entry.is_file())
        near = get_close_matches(path.name, names, n=3, cutoff=0.5)
        near = near or [name for name in names if Path(name).suffix == path.suffix][:3]
        hint = f"near names in {str(folder)!r}: {', '.join(near) or 'none'}."
    meant = get_close_matches(path.name, bundled, n=1, cutoff=0.5)
    return f"did you mean the bundled {meant[0]!r}? {hint}" if meant else hint


def temporary_start(path: Path) -> str:
    """Return how the names of temporary files of a path begin: names have at most 255 bytes."""
    return f".{os.fsencode(path.name)[:100].decode(errors='ignore')}."


@contextmanager
def atomic_file(path: str | os.PathLike, *, durable: bool = True) -> Iterator[BinaryIO]:
    """Open a binary file for writing that replaces ``path`` only if the block succeeds: a temporary
    file ``.<name>.<process>-<thread>.tmp`` in the same folder, which is renamed at the end, and if
    ``durable`` flushed to the disk, so that it is complete even after a power failure.

    Raises:
        UserError: the folder is missing or can't be written, or the disk is full.
    """
    path = Path(path)
    temporary = path.with_name(f"{temporary_start(path)}{os.getpid()}-{get_ident()}.tmp")
    try:
        with open(temporary, "wb") as file:
            yield file
            file.flush()
            if durable:
                os.fsync(file.fileno())
        os.replace(temporary, path)
        if durable:
            _sync_folder(path.parent)
    except OSError as error:
        why = f"{error.strerror or error}. An earlier file of this name is untouched."
        raise UserError(f"cannot write {str(path)!r}: {why}") from error
    finally:
        temporary.unlink(missing_ok=True)


def write_file(path: str | os.PathLike, content: bytes | str, *, durable: bool = True) -> None:
    """Write a file by :func:`atomic_file`; text as UTF-8, names of files in it with their bytes."""
    if isinstance(content, str):
        content = content.encode(errors="surrogateescape")
    with atomic_file(path, durable=durable) as file:
        file.write(content)


def json_text(content: Any, **options: Any) -> str:
    """Encode as JSON, with ``null`` for numbers that JSON doesn't have: NaN and the infinities."""
    return json.dumps(_without_infinities(content), allow_nan=False, **options)


def _without_infinities(content: Any) -> Any:
    if isinstance(content, float):
        return content if math.isfinite(content) else None
    if isinstance(content, Mapping):
        return {key: _without_infinities(value) for key, value in content.items()}
    if isinstance(content, (list, tuple)):
        return [_without_infinities(value) for value in content]
    return content


def through_link(path: str | os.PathLike) -> Path:
    """Return where a link that a user names for writing leads to. :func:`atomic_file` replaces
    links, since one in a folder of results may lead to a file that has to be kept.
    """
    return Path(os.path.realpath(path) if os.path.islink(path) else path)


def require_writable(path: str | os.PathLike, what: str) -> None:
    """Raise UserError, which names the file by ``what``, if it can't be written."""
    path = usable_path(path, f"{what}:")
    if not path.parent.is_dir():
        raise UserError(f"{what}: there is no folder {_quoted(path.parent)}")
    if path.is_dir() or not os.access(path.parent, os.W_OK):
        why = "it is a folder" if path.is_dir() else "its folder is read-only"
        raise UserError(f"{what}: {_quoted(path)} can't be written: {why}")


def require_other_file(
    path: str | os.PathLike, source: str | os.PathLike, what: str = "OUT is IN"
) -> None:
    """Raise UserError if a file to be written is the existing one that it is made from."""
    if os.path.exists(source) and os.path.exists(path) and os.path.samefile(source, path):
        raise UserError(f"{what}: give it another name, so that {_quoted(source)} is kept")


def is_folder(path: str | os.PathLike) -> bool:
    """Return whether ``path`` is an existing folder; False for what can't be a file's name."""
    with suppress(ValueError):
        return os.path.isdir(os.path.expanduser(path))
    return False


def output_folder(path: str | os.PathLike, option: str, files: Collection[str] = ()) -> Path:
    """Make a folder for results, before the work that makes them; raise UserError, which names it
    by ``option``, unless it and the ``files`` of these names can be written.
    """
    folder = usable_path(path, f"{option}: the folder", home=True)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        why = error.strerror or error
        raise UserError(f"{option}: the folder {_quoted(folder)} can't be made: {why}") from error
    if not os.access(folder, os.W_OK | os.X_OK):
        raise UserError(f"{option}: the folder {_quoted(folder)} is read-only")
    for name in files:
        require_writable(folder / name, option)
    return folder


def _quoted(path: str | os.PathLike) -> str:
    """Quote a path for a message, at most 100 characters of it."""
    text = str(path)
    return repr(text if len(text) <= 100 else f"{text[:80]}...")


def _sync_folder(folder: Path) -> None:
    """Flush a folder to the disk, so that a renaming in it is durable."""
    with suppress(OSError):  # Windows and some network file systems can't
        descriptor = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
