"""Fixtures of the prompt tests."""

import pytest

from tests.helpers import tiny_models


@pytest.fixture(scope="module")
def models(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    return {
        "stable-diffusion": tiny_models.stable_diffusion(folder / "sd"),
        "deep-floyd": tiny_models.deep_floyd(folder / "if"),
        "other": tiny_models.stable_diffusion(folder / "other", seed=1),
    }
