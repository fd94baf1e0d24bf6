"""Trainings of a few steps on a few pictures."""

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
