"""Limit the memory that reading a file may allocate, in proportion to the file's size.

A small compressed file can announce gigabytes of data. Readers compute the memory that they need
from the header and check it here before they allocate anything."""

from .errors import UserError
from .memory import size_text

FIXED_BYTES = 24 << 20
BYTES_PER_FILE_BYTE = 64


def file_memory_budget(file_size: int) -> int:
    """Return how many bytes of memory reading a file of ``file_size`` bytes may take."""
    return FIXED_BYTES + BYTES_PER_FILE_BYTE * file_size


def require_file_memory(needed: int, file_size: int, name: str, content: str) -> None:
    """Check what a file announces against the memory budget of its size.

    Args:
        needed: bytes of memory that reading it takes, intermediate results included.
        name: the file, for the message ("SPZ file 'a.spz'").
        content: what is announced ("3000000 Gaussians").

    Raises:
        UserError: it needs more than :func:`file_memory_budget`.
    """
    if needed > (budget := file_memory_budget(file_size)):
        raise UserError(
            f"{name}: {content} would take {size_text(needed)} of memory, but a file of "
            f"{file_size} bytes may take {size_text(budget)} at most: it is damaged, or made to "
            "fill the memory."
        )
