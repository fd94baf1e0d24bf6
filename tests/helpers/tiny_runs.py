"""Checks of the results of runs of the tiny system."""

from pathlib import Path

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
    assert one["global_step"] == other["global_step"] and one["epoch"] == other["epoch"]
    assert all(
        torch.equal(one["state_dict"][key], other["state_dict"][key]) for key in one["state_dict"]
    )
    state, other_state = one["optimizer_states"][0]["state"], other["optimizer_states"][0]["state"]
    assert all(torch.equal(state[i][key], other_state[i][key]) for i in state for key in state[i])
