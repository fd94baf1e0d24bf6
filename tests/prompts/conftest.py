"""Fixtures of the prompt tests."""

from functools import partial
from types import SimpleNamespace

import pytest

from tests.helpers import tiny_models
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.models import model_files
from threestudio_gaussiandreamer.prompts import prompt_processors  # noqa: F401


def processed(folder, kind="stable-diffusion", **options):
    options = {"prompt": "a fox", "negative_prompt": "ugly"} | options
    options["pretrained_model_name_or_path"] = str(folder)
    return find(f"gaussiandreamer-{kind}-prompt-processor")(options)()


@pytest.fixture(scope="session")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {
        "stable-diffusion": tiny_models.stable_diffusion(folder / "sd"),
        "deep-floyd": tiny_models.deep_floyd(folder / "if"),
        "stable-diffusion-xl": tiny_models.stable_diffusion_xl(folder / "xl"),
        "stable-diffusion-3": tiny_models.stable_diffusion_3(folder / "3"),
        "other": tiny_models.stable_diffusion(folder / "other", seed=1),
    }


@pytest.fixture
def fox(models, tmp_path, monkeypatch):
    """Process a prompt in an empty folder."""
    monkeypatch.chdir(tmp_path)
    # with transformers imported a collection takes a third of a second
    monkeypatch.setattr(model_files, "gc", SimpleNamespace(collect=lambda: 0))
    return partial(processed, models["stable-diffusion"])
