"""Lightning's door to checkpoint files: written whole or not at all, the earlier one kept, never
unpickled into code.
"""

import os
from pathlib import Path
from typing import Any

from ..core.checkpoint_file import load_file, save_file
from ..host import pl


class AtomicCheckpointIO(pl.plugins.CheckpointIO):
    """Saves through a temporary file that is synced and renamed, with a checksum; see
    :mod:`.core.checkpoint_file`.
    """

    def __init__(self) -> None:
        self.saved_steps: dict[str, int] = {}

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any = None
    ) -> None:
        """Save a checkpoint; raises UserError, with the earlier file untouched, when the disk is
        full or the folder can't be written.
        """
        save_file(path, checkpoint)
        self.saved_steps[os.path.abspath(path)] = checkpoint.get("global_step", -1)

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = None, weights_only: Any = True
    ) -> dict[str, Any]:
        """Load a checkpoint; raises UserError when the file is missing, damaged or foreign.
        ``weights_only`` is always true, whatever is asked.
        """
        return load_file(path, "cpu" if map_location is None else map_location)

    def remove_checkpoint(self, path: str | os.PathLike) -> None:
        Path(path).unlink(missing_ok=True)

    def saved_step(self, path: str | os.PathLike) -> int:
        """Return the step that this process last wrote to ``path``; -1 for none."""
        return self.saved_steps.get(os.path.abspath(path), -1)
