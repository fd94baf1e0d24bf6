"""Files that a mesh file references: buffers of glTF, materials of OBJ, textures of both."""

import contextlib
import logging
import os
import stat
import unicodedata
import urllib.parse
from collections.abc import Iterator
from pathlib import Path
from typing import Optional

from .budget import Budget, fail

log = logging.getLogger(__name__)

ENCODINGS = ("latin-1", "cp1252", "cp1250", "cp1251", "gb18030", "shift_jis", "cp949", "big5")
"""Of names in files that aren't UTF-8."""
consulted: dict[str, Optional[tuple[int, int]]] = {}
"""The ``stamp`` of every file that a mesh has named, by path; the prior's cache reads and clears
it."""


def stamp(path: str | Path) -> Optional[tuple[int, int]]:
    """Return size and time of change of a file; None if there is none."""
    try:
        status = os.stat(path)
    except (OSError, ValueError):
        return None
    return status.st_size, status.st_mtime_ns


def utf8(text: bytes) -> bytes:
    """Return a text in UTF-8; one in another encoding becomes one character per byte, from which
    ``SideFiles`` finds the files that it names.
    """
    try:
        text.decode()
    except UnicodeDecodeError:
        return text if text[:2] in (b"\xff\xfe", b"\xfe\xff") else text.decode("latin-1").encode()
    return text


def _plain(name: str) -> str:
    return unicodedata.normalize("NFC", urllib.parse.unquote(name)).casefold()


def _spellings(name: str) -> set[str]:
    """Return how a mesh file may spell the name of a file, apart from case and accents' form."""
    name = unicodedata.normalize("NFC", name)
    raw = [name.encode(encoding, "backslashreplace") for encoding in ENCODINGS]
    texts = (x.decode(y, "backslashreplace") for x in raw for y in ("latin-1", "utf-8"))
    return {_plain(x) for x in (name, *texts)}


class SideFiles:
    """Reads files whose names are relative to the mesh file."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.path, self.budget = path, budget

    def read(self, name: str, otherwise: Optional[str] = None) -> Optional[bytes]:
        """Return the content of the file ``name``; log a warning and return None if there is none.

        The name is relative to the mesh's folder and may have the separators of Windows, quotes
        and escaped spaces. If there is no such file, one with the same base name next to the mesh
        is read, else one whose name differs in case, accents' form, percent-encoding or encoding.

        Args:
            otherwise: another name to try.

        Raises:
            UserError: it is no regular file (a FIFO would block), or can't be read.
        """
        for place in self._places(name, otherwise or name):
            try:
                return self._content(place)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except (OSError, ValueError) as error:  # ValueError: a NUL in the name
                fail(self.path, f"the file {name[:200]!r} that it names isn't readable: {error}")
        log.warning("%s names the file %r, which does not exist", self.path, name[:200])
        return None

    def _places(self, *names: str) -> Iterator[Path]:
        plain = [x.strip().strip("\"'").replace("\\ ", " ").replace("\\", "/") for x in names]
        relative = [x.lstrip("/") for x in plain]
        found = [self.path.parent / x for y in relative for x in (y, y.rpartition("/")[2])]
        yield from found
        for place in found:
            with contextlib.suppress(OSError, ValueError):
                beside = sorted(place.parent.iterdir())
                yield from (x for x in beside if _plain(place.name) in _spellings(x.name))

    def _content(self, path: Path) -> bytes:
        consulted[str(path)] = stamp(path)
        # without O_NONBLOCK, opening a FIFO blocks until another process opens it for writing
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise OSError(f"{str(path)!r} is not a regular file")
            self.budget.add_file(status.st_size)
            return file.read()
