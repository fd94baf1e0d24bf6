"""Helpers of the exact score tests."""

import math

import pytest
import torch

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance

trimesh = pytest.importorskip("trimesh")


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
    values = (
        torch.full((len(azimuths),), elevation),
        torch.tensor(azimuths),
        torch.full((len(azimuths),), 2.7),
    )
    fovy = torch.full((len(azimuths),), math.radians(50))
    return {
        "c2w": cameras.orbit_c2w(*values),
        "fovy": fovy,
        "elevation": values[0],
        "azimuth": values[1],
        "camera_distances": values[2],
        "height": height,
        "width": width,
    }
