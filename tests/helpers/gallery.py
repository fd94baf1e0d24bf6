"""Files and checkpoints of finished runs, and their comparison."""

from pathlib import Path
from typing import Any

import torch

from threestudio_gaussiandreamer.core.checkpoint_file import load_file


def only_run() -> Path:
    """Return the folder of the only run."""
    (folder,) = Path("outputs/tiny").iterdir()
    return folder


def files(folder: Path) -> set[str]:
    """List the files below a folder, relative to it."""
    return {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}


def assert_same_training(a: Path, b: Path) -> None:
    """Compare parameters, optimiser and step of two checkpoints bit for bit."""
    one, other = load_file(a), load_file(b)
    assert one["epoch"] == other["epoch"] and not differences(one, other)


def training_state(checkpoint: dict[str, Any]) -> dict[str, torch.Tensor]:
    """Return parameters, statistics, moments and the step."""
    found = {"step": torch.tensor(checkpoint["global_step"]), **checkpoint["state_dict"]}
    for i, state in checkpoint["optimizer_states"][0]["state"].items():
        found |= {f"{i}.{name}": torch.as_tensor(value) for name, value in state.items()}
    return found


def differences(a: dict[str, Any], b: dict[str, Any]) -> int:
    """Count the tensors of two checkpoints' training states that differ in any bit."""
    one, other = training_state(a), training_state(b)
    return len(one.keys() ^ other.keys()) + sum(
        not torch.equal(one[name], other[name]) for name in one.keys() & other.keys()
    )
