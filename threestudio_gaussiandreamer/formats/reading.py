"""Read files from anywhere: one message for every kind of damage, and a limit of the memory that a
file may take, in proportion to its size, since a small one can announce gigabytes."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np

from ..core.errors import UserError
from ..core.files import existing_file
from ..core.options import size_text

FIXED_BYTES = 24 << 20
BYTES_PER_FILE_BYTE = 64


class Unreadable(ValueError):
    """What is wrong with the file that :func:`reading` has opened, without its name."""


@contextmanager
def reading(path: str | PathLike, kind: str) -> Iterator[Path]:
    """Yield the existing file ``path``, a ``kind`` of file ("SPZ file") for the message.

    Raises:
        UserError: there is no such file, the block raises any error about its content, or a package
            that reads it is missing.
    """
    path = existing_file(path, kind)
    where = f"{kind} {str(path)!r}"
    try:
        with np.errstate(all="ignore"):
            yield path
    except (UserError, MemoryError):
        raise
    except Exception as error:  # parsers raise errors of many types
        reason = f"{type(error).__name__}: {error}"[:200]
        said = f"{where}: it is truncated, damaged or of another format ({reason})"
        if isinstance(error, ImportError):  # of a package that reads the format
            said = f"cannot read {where}: {error}"
        elif isinstance(error, Unreadable):
            said = f"{where}: {error}"
        elif isinstance(error, OSError):
            other = f" ({error.filename})" if error.filename not in (None, str(path)) else ""
            said = f"cannot read {where}: {error.strerror or error}{other}"
        raise UserError(said) from error


def require(fits: bool, problem: str) -> None:
    """Raise :class:`Unreadable` unless ``fits``."""
    if not fits:
        raise Unreadable(problem)


def whole_number(entry: Mapping[str, Any], key: str, default: Any = None) -> int:
    """Return a count or an offset of an object of JSON, which must be an integer of 0 or more."""
    value = entry.get(key, default)
    usual = type(value) is int and value >= 0
    require(usual, f"{key} should be 0 or more, not {str(value)[:40]}")
    return value


def require_file_memory(needed: int, file_size: int, content: str) -> None:
    """Raise :class:`Unreadable` if what is announced, the ``content`` ("30 Gaussians"), takes more
    bytes, intermediate results included, than a file of this size may.
    """
    budget = FIXED_BYTES + BYTES_PER_FILE_BYTE * file_size
    require(
        needed <= budget,
        f"{content} would take {size_text(needed)} of memory, but a file of {file_size} bytes may "
        f"take {size_text(budget)} at most: it is damaged, or made to fill the memory",
    )
