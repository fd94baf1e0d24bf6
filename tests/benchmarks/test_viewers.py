"""In headless Chromium, Spark and three.js render exported files like this package.

VIEWER_NODE_MODULES names the folder with the npm packages of ``benchmarks/viewers/browser.py``.
"""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.viewers import browser
from tests.helpers.painted_ball import painted_ball
from threestudio_gaussiandreamer.cameras import orbit_c2w, to_opencv
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians import axes, sh
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster, over_background
from threestudio_gaussiandreamer.meshes.write import write_textured_glb
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.surface.textured import MeshOptions, mesh_from_gaussians

MODULES = Path(os.environ.get("VIEWER_NODE_MODULES", "node_modules"))
SIZE, THREE, DISTANCE, FOVY, DILATION = 128, 192, 3.0, math.radians(40), 0.1


def asymmetric_cloud(count: int = 300) -> Gaussians:
    """Make opaque Gaussians of bounded colours that look different from every side."""
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([0.6, 0.9, 1.2]) - 0.4
    return Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=(0.03 + 0.05 * torch.rand(count, 3, generator=rng)).log(),
        logit_opacities=torch.full((count,), 2.0),
        sh=sh.rgb_to_sh0(torch.rand(count, 1, 3, generator=rng)),
    )


def drawn_from_the_front(cloud: Gaussians) -> torch.Tensor:
    """Render (H, W, 3) on white from azimuth 0, the front of our world."""
    c2w = orbit_c2w(torch.zeros(1), torch.zeros(1), torch.full((1,), DISTANCE))
    viewmats, Ks = to_opencv(c2w, torch.full((1,), FOVY), SIZE, SIZE)
    shapes = cloud.means, cloud.quats, cloud.log_scales.exp(), cloud.logit_opacities.sigmoid()
    view, options = (viewmats, Ks, SIZE, SIZE), {"background": torch.ones(1, 3), "eps2d": DILATION}
    return rasterize(*shapes, sh.sh0_to_rgb(cloud.sh[:, 0]), *view, **options).image[0]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog"])
def test_spark_shows_an_exported_file_as_our_renderer_does(tmp_path, suffix):
    if lacking := browser.missing(MODULES):
        pytest.skip(lacking)
    cloud, path = asymmetric_cloud(), tmp_path / f"cloud{suffix}"
    write_cloud(str(path), StoredCloud(cloud.arrays()).in_axes(axes.VIEWER_UP))
    c2w = np.eye(4)
    c2w[2, 3] = DISTANCE
    how = {"options": {"preBlurAmount": DILATION, "blurAmount": 0.0}}
    how["rotation"] = browser.UNTURNED if suffix == ".spz" else browser.HALF_TURN_ABOUT_X
    (shown,) = browser.draw_with_spark(path, [browser.Camera(c2w, FOVY)], SIZE, MODULES, **how)
    ours = drawn_from_the_front(cloud)
    spark = torch.from_numpy(shown / np.float32(255))
    # Spark stores 8 bits per colour and cuts Gaussians at sqrt(8) standard deviations
    assert float(psnr(spark, ours)) > 35
    assert float(psnr(spark.flip(1), ours)) < 25  # the cloud isn't symmetric


@pytest.mark.slow
@pytest.mark.parametrize("faces", [1500, 6000])
def test_three_draws_a_mesh_as_our_ray_caster_does(faces, tmp_path):
    if lacking := browser.missing(MODULES, [browser.THREE]):
        pytest.skip(lacking)
    ball = painted_ball(1500)
    means = ball.means * np.float32([1, 0.7, 0.9]) + np.float32([0.1, 0, 0.2])
    options = MeshOptions(faces=faces, texture=512, views=24, view_size=256, resolution=64)
    mesh = mesh_from_gaussians(ball._replace(means=means), options)
    rotation = axes.rotation_between(axes.WORLD_UP, "y")
    y_up = mesh._replace(vertices=mesh.vertices @ rotation.T)
    write_textured_glb(tmp_path / "mesh.glb", y_up, unlit=True)
    angles = torch.tensor([0.0, 70.0, 200.0])
    c2w = orbit_c2w(torch.tensor([10.0, 40, -20]), angles, torch.full((3,), 3.0)).double().numpy()
    ours = MeshCaster(mesh).render_views([(matrix, FOVY) for matrix in c2w], THREE, THREE)
    ours = torch.from_numpy(over_background(ours, np.ones(3, np.float32)))
    turned = c2w.copy()
    turned[:, :3] = rotation @ c2w[:, :3]
    cameras = [browser.Camera(matrix, FOVY) for matrix in turned]
    theirs = browser.draw_with_three(tmp_path / "mesh.glb", cameras, THREE, MODULES)
    theirs = torch.from_numpy(theirs / 255).float()
    assert psnr(theirs, ours) > 35
    assert psnr(theirs.flip(2), ours) < 25  # a mirrored picture is seen to be wrong
    assert psnr(theirs**2.2, ours) < 25  # and so are wrong colours
