"""Fixtures of the toybox tests: a small world, and a folder with trained stages."""

import contextlib
import shutil
from collections.abc import Iterator

import pytest

from tests.toybox.helpers import training
from threestudio_gaussiandreamer.toybox import loop, models, motion_stage, views
from threestudio_gaussiandreamer.toybox.export import main as export


@contextlib.contextmanager
def small_sizes() -> Iterator[None]:
    """Make images few and networks small meanwhile, so that a step takes milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        for owner, sizes in (
            (models, {"UNET_CHANNELS": (16, 32), "VAE_CHANNELS": (8, 8, 8, 8), "TEXT_LAYERS": 1}),
            (models, {"VISION_LAYERS": 1, "POINTS_LAYERS": 1, "MOTION_LAYERS": 1}),
            (motion_stage, {"EACH": 1}),
            (models.Classifier, {"CHANNELS": (8, 8, 8, 8)}),
            (views, {"POINTS": 300, "OBJECTS": 4, "HELD_OUT_OBJECTS": 4}),
            (loop, {"LOG_EVERY": 1, "WARMUP": 1}),
        ):
            for name, value in sizes.items():
                patch.setattr(owner, name, value)
        yield


@pytest.fixture(scope="module")
def small_world():
    with small_sizes():
        yield


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """A training folder in which text encoder, CLIP and autoencoder are trained for two steps; no
    test changes it, nor those below.
    """
    folder = tmp_path_factory.mktemp("toybox")
    with small_sizes():
        for name in ("text", "clip", "autoencoder"):
            training(folder, name).run(8)
    return folder


@pytest.fixture(scope="session")
def trained(folder, tmp_path_factory):
    """A folder in which every stage is trained for a step."""
    place = shutil.copytree(folder, tmp_path_factory.mktemp("trained") / "toybox")
    with small_sizes():
        for name in ("unet", "points", "motion", "judge"):
            training(place, name).run(4)
    return place


@pytest.fixture(scope="session")
def exported(trained, tmp_path_factory):
    target = tmp_path_factory.mktemp("models")
    with small_sizes():
        assert export([str(trained), str(target)]) == 0
    return target
