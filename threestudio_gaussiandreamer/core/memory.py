"""Reject options that need more memory than this machine has, before anything is allocated."""

import os
from functools import cache
from pathlib import Path
from typing import Any

from .errors import UserError
from .options import Rule, is_whole, rule, wrong

CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")


@cache
def memory_bytes() -> int:
    """Return the bytes of the largest memory: the machine's (or its container's) or one GPU's."""
    import torch

    gpus = torch.cuda.device_count() if torch.cuda.is_available() else 0
    found = [torch.cuda.get_device_properties(i).total_memory for i in range(gpus)]
    return max([main_memory(), *found])


def main_memory() -> int:
    """Return the bytes of the machine's or its container's memory, which a GPU's isn't part of."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not a POSIX system
        return 2**40
    limit = CGROUP_LIMIT.read_text(encoding="utf-8").strip() if CGROUP_LIMIT.is_file() else "max"
    return min(total, int(limit)) if limit.isdigit() else total


def require_memory(options: str, needed: float, what: str) -> None:
    """Raise UserError if about ``needed`` bytes exceed :func:`memory_bytes`.

    Args:
        options: the names of the options that determine the size, for the message.
        what: names the data in the message, such as "24 pictures of 256 x 256 pixels".
    """
    if needed > memory_bytes():
        raise UserError(
            f"{options}: {what} take about {size_text(needed)} of memory, and this machine has "
            f"{size_text(memory_bytes())}; take less"
        )


def count_of(things: str, low: int, bytes_each: int) -> Rule:
    """Return a rule for counts of ``things``: whole numbers of at least ``low``, limited by the
    memory, of which each takes ``bytes_each``.
    """

    def check(path: str, value: Any) -> None:
        if not is_whole(value) or value < low:
            raise wrong(path, f"{low} or more {things}", value)
        require_memory(path, bytes_each * value, f"{value} {things}")

    return rule(check)


def size_text(count: float) -> str:
    """Format a number of bytes with a unit, such as "24 GB"."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.4g} TB"
