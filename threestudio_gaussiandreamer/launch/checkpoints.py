"""Lightning's checkpoint I/O: files are written atomically and loaded with ``weights_only``, so
that they can't run code.
"""

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from ..core.checkpoint_file import load_file, save_file
from ..host import pl


class AtomicCheckpointIO(pl.plugins.CheckpointIO):
    """Save checkpoints with a checksum into a temporary file that is synced and renamed; see
    :mod:`.core.checkpoint_file`.

    Args:
        first: returns a context in which the first checkpoint is written.
    """

    def __init__(self, first: Callable[[], Any] = contextlib.nullcontext) -> None:
        self.first = first
        self.saved_steps: dict[str, int] = {}
        self.seconds = 0.0
        """Duration of the last write."""

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any = None
    ) -> None:
        """Save a checkpoint atomically.

        Raises:
            UserError: the disk is full or the folder can't be written; an existing file is left
                unchanged.
        """
        started = time.monotonic()
        with contextlib.nullcontext() if self.saved_steps else self.first():
            save_file(path, checkpoint)
        self.seconds = time.monotonic() - started
        self.saved_steps[os.path.abspath(path)] = checkpoint.get("global_step", -1)

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = None, weights_only: Any = True
    ) -> dict[str, Any]:
        """Load a checkpoint, always with ``weights_only``, whatever the argument's value.

        Raises:
            UserError: the file is missing, damaged, or no checkpoint.
        """
        return load_file(path, "cpu" if map_location is None else map_location)

    def remove_checkpoint(self, path: str | os.PathLike) -> None:
        Path(path).unlink(missing_ok=True)

    def saved_step(self, path: str | os.PathLike) -> int:
        """Return the step of the checkpoint that this process last wrote to ``path``; -1 if it has
        written none.
        """
        return self.saved_steps.get(os.path.abspath(path), -1)
