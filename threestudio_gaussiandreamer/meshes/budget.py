"""The memory that one mesh file may take, charged from its headers before anything is allocated.

A small file can announce a lot: a PNG of one colour, a thousand nodes that show one mesh, an
accessor of a billion zeros. The budget is one sum for the whole file and the files it names."""

from pathlib import Path
from typing import NoReturn

from ..core.errors import UserError

FIXED_BYTES = 640 << 20
"""What any file may take: one texture of 8192 x 8192, or three million triangles."""
BYTES_PER_BYTE = 64
"""What each byte that is stored may take besides."""
BYTES_PER_TEXEL = 8
BYTES_PER_VERTEX = 200
BYTES_PER_FACE = 150
"""Peaks while a part is decoded, merged, cleaned and brought into its pose."""


def fail(path: Path, problem: str) -> NoReturn:
    """Raise UserError: the mesh ``path`` can't be read, and why."""
    raise UserError(f"can't read the mesh {str(path)!r}: {problem}")


class Budget:
    """Bytes that the mesh ``path`` may still take; a side file adds to them, content takes away."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.left = FIXED_BYTES
        self.total = FIXED_BYTES
        self.add_file(path.stat().st_size)

    def add_file(self, size: int) -> None:
        """Allow what a file of ``size`` bytes may take besides."""
        self.left += BYTES_PER_BYTE * size
        self.total += BYTES_PER_BYTE * size

    def spend(self, size: int, what: str) -> None:
        """Take ``size`` bytes for ``what``.

        Raises:
            UserError: the file's content would take more than the budget.
        """
        self.left -= size
        if self.left < 0:
            fail(
                self.path,
                f"{what} is too large: textures, vertices and faces of a file of this size may "
                f"take {self.total >> 20} MiB of memory together",
            )

    def spend_geometry(self, vertices: int, faces: int) -> None:
        """Take the bytes of one part of the scene.

        Raises:
            UserError: the file's content would take more than the budget.
        """
        size = BYTES_PER_VERTEX * vertices + BYTES_PER_FACE * faces
        self.spend(size, f"a part with {vertices} vertices and {faces} faces")
