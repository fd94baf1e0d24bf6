"""Trainings of a few steps on a few pictures."""

import contextlib
import resource
import shutil
from collections.abc import Iterator
from pathlib import Path

from threestudio_gaussiandreamer.toybox import loop
from threestudio_gaussiandreamer.toybox.train import STAGES


def options(folder: Path, **more) -> loop.Options:
    return loop.Options(folder=Path(folder), pool=2, batch=4, **more)


def training(folder: Path, name: str, **more) -> loop.Training:
    """Open a stage's training without its measurement, which has a test of its own."""
    result = loop.Training(STAGES[name](options(folder, **more)))
    result.stage.evaluate = lambda model: {}
    return result


def copied(source: Path, target: Path) -> Path:
    """Copy a folder of checkpoints, tokenizer and pictures."""
    shutil.copytree(source, target)
    return target


@contextlib.contextmanager
def largest_file(size: int) -> Iterator[None]:
    """Let writing beyond ``size`` bytes fail, as it does where the disk is full."""
    earlier = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, earlier[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, earlier)
