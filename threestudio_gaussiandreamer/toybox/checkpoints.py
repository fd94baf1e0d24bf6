"""The checkpoints of the toybox's stages: where they are, and what others read from them."""

from collections.abc import Collection
from pathlib import Path
from typing import Any

from torch import Tensor

from ..core.checkpoint_file import entries_below, load_file
from ..core.errors import UserError


def checkpoint_path(folder: Path, name: str) -> Path:
    """Return the path of a stage's checkpoint."""
    return Path(folder) / f"{name}.pt"


def is_trained(folder: Path, *names: str) -> bool:
    """Return whether there is a checkpoint of any of these stages."""
    return any(checkpoint_path(folder, name).exists() for name in names)


def averaged_weights(folder: Path, name: str) -> dict[str, Tensor]:
    """Read the averaged weights of a stage's checkpoint.

    Raises:
        UserError: the stage isn't trained yet, or its file is damaged.
    """
    path = checkpoint_path(folder, name)
    if not path.exists():
        raise UserError(f"{path} is missing: train the stage {name!r} first")
    return entries_below(load_file(path)["ema"], "module.")


def read_checkpoint(path: Path, needed: Collection[str]) -> dict[str, Any]:
    """Read the checkpoint of a stage.

    Args:
        needed: names of entries.

    Raises:
        UserError: it is damaged, or lacks one of them.
    """
    content = load_file(path)
    missing = set(needed) - set(content if isinstance(content, dict) else ())
    if missing:
        raise UserError(
            f"{path} isn't a checkpoint of the toybox's training: it has no "
            f"{', '.join(sorted(missing))}"
        )
    return content
