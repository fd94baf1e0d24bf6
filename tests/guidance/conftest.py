"""Fixtures of the guidance tests, and helpers of those of the exact score."""

import functools
import math

import numpy as np
import pytest
import torch

from tests.helpers import tiny_large_guidance, tiny_models
from tests.helpers.tiny_guidance import make_models, make_prompts
from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance


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


def uniform(*shape, seed=0):
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed))


def step(guidance, rgb, **batch):
    rgb = rgb.clone().requires_grad_()
    out = guidance(rgb, None, **batch)
    out["loss_sds"].backward()
    return out, rgb.grad


def guidance(mesh_path, **options):
    return ExactScoreGuidance({"mesh": mesh_path, "bank_views": 24, **options})


def batch(*azimuths, elevation=10.0, height=16, width=16):
    same = torch.ones(len(azimuths))
    angles = {"elevation": elevation * same, "azimuth": torch.tensor(azimuths)}
    angles["camera_distances"] = 2.7 * same
    c2w, fovy = cameras.orbit_c2w(*angles.values()), math.radians(50) * same
    return angles | {"c2w": c2w, "fovy": fovy, "height": height, "width": width}
