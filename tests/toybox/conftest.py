"""Fixtures of the toybox tests: a small world, and a folder with trained stages."""

import pytest

from tests.toybox.helpers import training
from threestudio_gaussiandreamer.toybox import loop, models, views
from threestudio_gaussiandreamer.toybox.export import main as export


@pytest.fixture(scope="module")
def small_world():
    """Make images few and networks small, so that a step takes milliseconds."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(models, "UNET_CHANNELS", (16, 32))
        patch.setattr(models, "VAE_CHANNELS", (8, 8, 8, 8))
        patch.setattr(models, "TEXT_LAYERS", 1)
        patch.setattr(models, "VISION_LAYERS", 1)
        patch.setattr(models, "POINTS_LAYERS", 1)
        patch.setattr(models.Judge, "CHANNELS", (8, 8, 8, 8))
        patch.setattr(views, "POINTS", 300)
        patch.setattr(views, "HELD_OUT_OBJECTS", 4)
        patch.setattr(loop, "LOG_EVERY", 1)
        patch.setattr(loop, "WARMUP", 1)
        yield


@pytest.fixture(scope="module")
def folder(tmp_path_factory, small_world):
    """A training folder in which text encoder, CLIP and autoencoder are trained for two steps."""
    folder = tmp_path_factory.mktemp("toybox")
    for name in ("text", "clip", "autoencoder"):
        training(folder, name).run(8)
    return folder


@pytest.fixture(scope="module")
def trained(folder):
    """A folder in which every stage is trained for a step."""
    for name in ("unet", "points", "judge"):
        training(folder, name).run(4)
    return folder


@pytest.fixture(scope="module")
def exported(trained, tmp_path_factory):
    target = tmp_path_factory.mktemp("models")
    assert export([str(trained), str(target)]) == 0
    return target
