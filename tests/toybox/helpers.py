"""Trainings of a few steps on a few pictures."""

import shutil
from pathlib import Path

from threestudio_gaussiandreamer.toybox import loop
from threestudio_gaussiandreamer.toybox.train import STAGES

OBJECTS = 4
"""Of a shard."""


def options(folder: Path, **more) -> loop.Options:
    return loop.Options(folder=Path(folder), pool=2, shard_objects=OBJECTS, batch=4, **more)


def training(folder: Path, name: str, **more) -> loop.Training:
    """Open a stage's training without its sheets, which have a test of their own."""
    result = loop.Training(STAGES[name](options(folder, **more)))
    result._show = lambda: None
    return result


def copied(source: Path, target: Path) -> Path:
    """Copy a folder of checkpoints, tokenizer and pictures."""
    shutil.copytree(source, target)
    return target
