"""Fixtures of the guidance tests."""

import functools

import numpy as np
import pytest

from tests.helpers import tiny_large_guidance, tiny_models
from tests.helpers.tiny_guidance import make_models, make_prompts


@pytest.fixture(scope="session")
def mesh_path(tmp_path_factory):
    """Write a ball with a nose: red in front, green behind, blue on top."""
    import trimesh

    ball = trimesh.creation.icosphere(4, 1.0)
    nose = trimesh.creation.icosphere(2, 0.35)
    nose.apply_translation([1.1, 0, 0])
    mesh = trimesh.util.concatenate([ball, nose])
    colors = np.full((len(mesh.vertices), 3), 60)
    colors[mesh.vertices[:, 0] > 0.1] = [230, 30, 30]
    colors[mesh.vertices[:, 0] < -0.1] = [20, 200, 40]
    colors[mesh.vertices[:, 2] > 0.6] = [40, 60, 240]
    mesh.visual = trimesh.visual.ColorVisuals(mesh, vertex_colors=colors)
    path = tmp_path_factory.mktemp("mesh") / "ball.ply"
    mesh.export(path)
    return str(path)


@pytest.fixture(scope="session")
def models(tmp_path_factory):
    return make_models(tmp_path_factory.mktemp("models"))


@pytest.fixture(scope="session")
def prompts(models):
    return make_prompts(models)


@pytest.fixture(scope="session")
def large(tmp_path_factory):
    """Return a function that makes, once, the folder and the prompts of a kind of model."""

    @functools.cache
    def made(kind):
        make = getattr(tiny_models, kind.replace("-", "_"))
        folder = make(tmp_path_factory.mktemp("models") / kind)
        text = "stable-diffusion" if kind == "mvdream" else kind
        return folder, tiny_large_guidance.prompts(text, folder)

    return made
