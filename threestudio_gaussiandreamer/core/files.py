"""Reading and writing files so that a mistake is one clear message and a crash leaves nothing
half-written.
"""

import json
import math
import os
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from pathlib import Path
from threading import get_ident
from typing import Any, BinaryIO

from .errors import UserError


def existing_file(path: str | os.PathLike, kind: str, bundled: Collection[str] = ()) -> Path:
    """Return ``path`` as a :class:`Path` if a file is there; ``kind`` ("mesh", "PLY file") names it
    in the message.

    Args:
        bundled: bare names of packaged files, for the message only.

    Raises:
        UserError: nothing, or no file, is there; the message lists the files of that folder with
            near names.
    """
    try:
        path = Path(path).expanduser()
        if path.is_file():
            return path
        reason = "is a folder, not a file" if path.is_dir() else "does not exist"
        neighbours = near_names(path, bundled)
    except (OSError, ValueError, RuntimeError) as error:
        # a name too long, a NUL inside, the home folder of an unknown user
        raise UserError(f"{kind} {str(path)!r}: not a usable file name ({error}).") from error
    raise UserError(f"{kind} {str(path)!r} {reason}{neighbours}")


def near_names(path: Path, bundled: Collection[str] = ()) -> str:
    """Write the end of a "missing" message: the files beside ``path`` with near names or of its
    kind, or a bundled one that may be meant.
    """
    folder = path.parent
    names = (
        sorted(entry.name for entry in folder.iterdir() if entry.is_file())
        if folder.is_dir()
        else []
    )
    near = get_close_matches(path.name, names, n=3, cutoff=0.5)
    if not near and (meant := get_close_matches(path.name, bundled, n=1, cutoff=0.5)):
        return f"; did you mean the bundled {meant[0]!r}?"
    if not folder.is_dir():
        return f": there is no folder {str(folder)!r} either."
    near = near or [name for name in names if Path(name).suffix == path.suffix][:3]
    return (
        f"; near names in {str(folder)!r}: {', '.join(near)}."
        if near
        else f"; no file in {str(folder)!r} has a near name."
    )


@contextmanager
def atomic_file(path: str | os.PathLike, *, durable: bool = True) -> Iterator[BinaryIO]:
    """Open a binary file that appears under ``path`` whole, on success, or not at all; what was
    there stays until then.

    The content goes to a temporary file beside it, which takes the name when it is whole.

    Args:
        durable: wait until it is on the disk, so that it is whole also after a loss of power.

    Raises:
        UserError: the folder is missing or unwritable, the disk is full, ...
    """
    path = Path(path)
    temporary = path.with_name(f".{_shortened(path.name)}.{os.getpid()}-{get_ident()}.tmp")
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
        raise UserError(
            f"cannot write {str(path)!r}: {error.strerror or error}. An earlier file of this "
            "name is untouched."
        ) from error
    finally:
        temporary.unlink(missing_ok=True)


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


def _shortened(name: str, size: int = 100) -> str:
    """Cut a file's name to at most ``size`` bytes, so that more can be appended to it."""
    return name.encode(errors="surrogateescape")[:size].decode(errors="ignore")


def require_writable(path: str | os.PathLike, what: str) -> None:
    """Check that a file can be written under a name, before the work that makes its content.

    Args:
        path: the file, which need not exist; one that does will be replaced.
        what: names it in messages.

    Raises:
        UserError: the name holds NUL or is too long, its folder is missing or can't be written, or
            a folder has that name.
    """
    path = Path(path)
    try:
        path.lstat()
    except (FileNotFoundError, NotADirectoryError):
        pass
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"{what}: {_quoted(path)} can't be a file's name: {reason}") from error
    if not path.parent.is_dir():
        raise UserError(f"{what}: there is no folder {_quoted(path.parent)}")
    if path.is_dir():
        raise UserError(f"{what}: {_quoted(path)} can't be written: it is a folder")
    if not os.access(path.parent, os.W_OK):
        raise UserError(f"{what}: {_quoted(path)} can't be written: its folder is read-only")


def _quoted(path: Path) -> str:
    """Quote a path for a message, at most 100 characters of it."""
    text = str(path)
    return repr(text if len(text) <= 100 else f"{text[:80]}...")


def _sync_folder(folder: Path) -> None:
    """Make the renaming itself durable, where the system lets a folder be opened (not on
    Windows).
    """
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except OSError:
        return
    try:
        os.fsync(descriptor)
    except OSError:
        pass  # some network file systems can't; the file itself is synced
    finally:
        os.close(descriptor)
