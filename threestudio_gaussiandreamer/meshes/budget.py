"""Limit the memory that loading a mesh may allocate, by the sizes in the headers.

A small file can expand to a large size: a PNG of one colour, a thousand nodes that instance one
mesh, an accessor of a billion zeros. There is one budget for a mesh file and the files that it
references."""

from pathlib import Path
from typing import NoReturn

from ..core.errors import UserError
from ..core.file_memory import BYTES_PER_FILE_BYTE

FIXED_BYTES = 640 << 20
"""Budget of every file: one texture of 8192 x 8192, or three million triangles. There are
``BYTES_PER_FILE_BYTE`` per byte of the file in addition.
"""
BYTES_PER_TEXEL = 8
BYTES_PER_VERTEX = 200
BYTES_PER_FACE = 150
"""Peak memory while a part is decoded, merged, cleaned and transformed."""


def fail(path: Path, problem: str) -> NoReturn:
    """Raise UserError with the reason why ``path``, of a mesh or of Gaussians in glTF, can't be
    read.
    """
    raise UserError(f"can't read {str(path)!r}: {problem}")


class Budget:
    """The remaining memory budget of the mesh ``path``, bytes: increased by the size of every file
    that is read, reduced by decoded content.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.left = FIXED_BYTES
        self.total = FIXED_BYTES
        self.add_file(path.stat().st_size)

    def add_file(self, size: int) -> None:
        """Increase the budget for a file of ``size`` bytes."""
        self.left += BYTES_PER_FILE_BYTE * size
        self.total += BYTES_PER_FILE_BYTE * size

    def spend(self, size: int, what: str) -> None:
        """Deduct ``size`` bytes; ``what`` names the content in the message.

        Raises:
            UserError: the budget is exceeded.
        """
        self.left -= size
        if self.left < 0:
            fail(
                self.path,
                f"{what} is too large: textures, vertices and faces of a file of this size may "
                f"take {self.total >> 20} MiB of memory together",
            )

    def spend_geometry(self, vertices: int, faces: int) -> None:
        """Deduct the bytes of one part of the scene.

        Raises:
            UserError: the budget is exceeded.
        """
        size = BYTES_PER_VERTEX * vertices + BYTES_PER_FACE * faces
        self.spend(size, f"a part with {vertices} vertices and {faces} faces")
