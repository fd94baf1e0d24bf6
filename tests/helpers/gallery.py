"""Tiny runs of ``smoke.yaml``, each made once for all tests and workers, and their comparison."""

import contextlib
import io
import itertools
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import torch
from filelock import FileLock

from threestudio_gaussiandreamer.core.checkpoint_file import load_file
from threestudio_gaussiandreamer.core.errors import UserError

FORMATS = "system.exporter.formats=[ply,compressed-ply,spz,sog,glb,usda,points]"
LAST = "resume={root}/trained/ckpts/last.ckpt"
RUNS = {
    "trained": ["--config", "smoke.yaml", "--train", "checkpoint.save_top_k=-1"],
    "exported": ["--config", "trained", "--export", FORMATS, LAST],
    "resumed": [
        "--config",
        "trained",
        "--train",
        "resume={root}/trained/ckpts/epoch=0-step=4.ckpt",
    ],
    "failed": ["--config", "smoke.yaml", "--train"],
}
"""Arguments of each run. All have 8 steps, densify at 2, 4 and 6, prune at 3 and 6, save
checkpoints at 4 and 8, validate at 4 and 8, and test at the end, but "failed", whose guidance fails
after 5 steps: exit code 2, and last.ckpt."""


def fails_after(calls: int, function: Callable) -> Callable:
    """Return ``function``, which raises an error from its call number ``calls + 1`` on."""
    count = itertools.count(1)

    def failing(*args, **kwargs):
        if next(count) > calls:
            raise UserError("the guidance has failed")
        return function(*args, **kwargs)

    return failing


class Gallery:
    """``Gallery(root)(name)`` returns the folder of a run, which it makes if no worker has."""

    def __init__(self, root: Path):
        self.root = root

    def __call__(self, name: str) -> Path:
        self.root.mkdir(exist_ok=True)
        with FileLock(self.root / f"{name}.lock"):
            if not (self.root / f"{name}.code").exists():
                self._make(name)
        return self.root / name

    def said(self, name: str) -> str:
        """Return what a run wrote to both outputs."""
        self(name)
        return (self.root / f"{name}.txt").read_text()

    def code(self, name: str) -> int:
        """Return a run's exit code."""
        self(name)
        return int((self.root / f"{name}.code").read_text())

    def _make(self, name: str) -> None:
        from threestudio_gaussiandreamer.guidance.mock import MockGuidance
        from threestudio_gaussiandreamer.launch.experiment import main

        arguments = list(RUNS[name])
        if arguments[1] in RUNS:
            arguments[1] = str(self(arguments[1]) / "configs" / "parsed.yaml")
        arguments = [argument.format(root=self.root) for argument in arguments]
        faulty = mock.patch.object(MockGuidance, "encode", fails_after(5, MockGuidance.encode))
        fault = faulty if name == "failed" else contextlib.nullcontext()
        with fault, mock.patch.dict(os.environ), contextlib.redirect_stdout(io.StringIO()) as said:
            with contextlib.redirect_stderr(said):
                code = main(
                    [
                        *arguments, "--gpu", "cpu", f"exp_root_dir={self.root.parent}",
                        f"name={self.root.name}", "use_timestamp=false", f"tag={name}",
                        "checkpoint.every_n_train_steps=4", "trainer.val_check_interval=4",
                    ]
                )  # fmt: skip
        (self.root / f"{name}.txt").write_text(said.getvalue())
        (self.root / f"{name}.code").write_text(str(code))


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
    moments = checkpoint["optimizer_states"][0]["state"]
    found = {
        f"{i}.{name}": torch.as_tensor(value)
        for i, state in moments.items()
        for name, value in state.items()
    }
    return {**checkpoint["state_dict"], **found, "step": torch.tensor(checkpoint["global_step"])}


def differences(a: dict[str, Any], b: dict[str, Any]) -> int:
    """Count the tensors of two checkpoints' training states that differ in any bit."""
    one, other = training_state(a), training_state(b)
    return len(one.keys() ^ other.keys()) + sum(
        not torch.equal(one[name], other[name]) for name in one.keys() & other.keys()
    )
