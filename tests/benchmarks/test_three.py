"""three.js in headless Chromium draws a GLB of ours as our ray caster does: upright, with the same
outlines and colours.

The environment variable VIEWER_NODE_MODULES names a folder node_modules with the package three.
"""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.viewers import browser
from tests.helpers.painted_ball import painted_ball
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.gaussians.axes import WORLD_UP, rotation_between
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, over_background
from threestudio_gaussiandreamer.meshes.write import write_textured_glb
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.surface.textured import MeshOptions, mesh_from_gaussians

MODULES = Path(os.environ.get("VIEWER_NODE_MODULES", "node_modules"))
SIZE, FOVY = 192, math.radians(40)


@pytest.mark.slow
@pytest.mark.parametrize("faces", [1500, 6000])
def test_three_draws_a_mesh_as_our_ray_caster_does(faces, tmp_path):
    if lacking := browser.missing(MODULES, [browser.THREE]):
        pytest.skip(lacking)
    ball = painted_ball(1500)
    means = ball.means * np.float32([1, 0.7, 0.9]) + np.float32([0.1, 0, 0.2])
    options = MeshOptions(faces=faces, texture=512, views=24, view_size=256, resolution=64)
    mesh = mesh_from_gaussians(ball._replace(means=means), options)
    rotation = rotation_between(WORLD_UP, "y")
    y_up = mesh._replace(vertices=mesh.vertices @ rotation.T)
    write_textured_glb(tmp_path / "mesh.glb", y_up, unlit=True)
    angles = torch.tensor([0.0, 70.0, 200.0])
    c2w = orbit_c2w(torch.tensor([10.0, 40, -20]), angles, torch.full((3,), 3.0)).double().numpy()
    ours = MeshCaster(mesh).render_views([(matrix, FOVY) for matrix in c2w], SIZE, SIZE)
    ours = torch.from_numpy(over_background(ours, np.ones(3, np.float32)))
    turned = c2w.copy()
    turned[:, :3] = rotation @ c2w[:, :3]
    cameras = [browser.Camera(matrix, FOVY) for matrix in turned]
    theirs = browser.draw_with_three(tmp_path / "mesh.glb", cameras, SIZE, MODULES)
    theirs = torch.from_numpy(theirs / 255).float()
    assert psnr(theirs, ours) > 35
    assert psnr(theirs.flip(2), ours) < 25  # a mirrored picture is seen to be wrong
    assert psnr(theirs**2.2, ours) < 25  # and so are wrong colours
