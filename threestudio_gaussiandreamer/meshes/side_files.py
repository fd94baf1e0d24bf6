"""Files that a mesh file references: buffers of glTF, materials of OBJ, textures of both."""

import logging
import os
import stat
from pathlib import Path
from typing import Optional

from .budget import Budget, fail

log = logging.getLogger(__name__)


class SideFiles:
    """Reads files whose names are relative to the mesh file."""

    def __init__(self, path: Path, budget: Budget) -> None:
        self.path, self.budget = path, budget

    def read(self, name: str, otherwise: Optional[str] = None) -> Optional[bytes]:
        """Return the content of the file ``name``; log a warning and return None if there is none.

        The name is relative to the mesh's folder and may have the separators of Windows. If there
        is no such file, one with the same base name next to the mesh is read.

        Args:
            otherwise: another name to try.

        Raises:
            UserError: it is no regular file (a FIFO would block), or can't be read.
        """
        names = [x.strip().replace("\\", "/").lstrip("/") for x in (name, otherwise or name)]
        for candidate in (x for relative in names for x in (relative, relative.rpartition("/")[2])):
            try:
                return self._content(self.path.parent / candidate)
            except (FileNotFoundError, NotADirectoryError):
                continue
            except (OSError, ValueError) as error:  # ValueError: a NUL in the name
                fail(self.path, f"the file {name[:200]!r} that it names isn't readable: {error}")
        log.warning("%s names the file %r, which does not exist", self.path, name[:200])
        return None

    def _content(self, path: Path) -> bytes:
        # without O_NONBLOCK, opening a FIFO blocks until another process opens it for writing
        descriptor = os.open(path, os.O_RDONLY | getattr(os, "O_NONBLOCK", 0))
        with open(descriptor, "rb") as file:
            status = os.fstat(descriptor)
            if not stat.S_ISREG(status.st_mode):
                raise OSError(f"{str(path)!r} is not a regular file")
            self.budget.add_file(status.st_size)
            return file.read()
