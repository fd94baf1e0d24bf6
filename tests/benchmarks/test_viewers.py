"""Spark in headless Chromium renders an exported file like this package: upright, facing the
camera, in the same colours.

The environment variable VIEWER_NODE_MODULES names the folder node_modules with the npm packages of
``benchmarks/viewers/browser.py``.
"""

import math
import os
from pathlib import Path

import numpy as np
import pytest
import torch

from benchmarks.viewers import browser
from threestudio_gaussiandreamer.cameras import orbit_c2w, to_opencv
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import VIEWER_UP
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0, sh0_to_rgb
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting import rasterize

MODULES = Path(os.environ.get("VIEWER_NODE_MODULES", "node_modules"))
SIZE, DISTANCE, FOVY, DILATION = 128, 3.0, math.radians(40), 0.1


def asymmetric_cloud(count: int = 300) -> Gaussians:
    """Make opaque Gaussians of bounded colours that look different from every side."""
    rng = torch.Generator().manual_seed(0)
    means = torch.rand(count, 3, generator=rng) * torch.tensor([0.6, 0.9, 1.2]) - 0.4
    return Gaussians(
        means=means,
        quats=torch.randn(count, 4, generator=rng),
        log_scales=(0.03 + 0.05 * torch.rand(count, 3, generator=rng)).log(),
        logit_opacities=torch.full((count,), 2.0),
        sh=rgb_to_sh0(torch.rand(count, 1, 3, generator=rng)),
    )


def drawn_from_the_front(cloud: Gaussians) -> torch.Tensor:
    """Render (H, W, 3) on white from azimuth 0, the front of our world."""
    c2w = orbit_c2w(torch.zeros(1), torch.zeros(1), torch.full((1,), DISTANCE))
    viewmats, Ks = to_opencv(c2w, torch.full((1,), FOVY), SIZE, SIZE)
    shapes = cloud.means, cloud.quats, cloud.log_scales.exp(), cloud.logit_opacities.sigmoid()
    colors = sh0_to_rgb(cloud.sh[:, 0])
    white = torch.ones(1, 3)
    return rasterize(
        *shapes, colors, viewmats, Ks, SIZE, SIZE, background=white, eps2d=DILATION
    ).image[0]


@pytest.mark.slow
@pytest.mark.parametrize("suffix", [".ply", ".compressed.ply", ".spz", ".sog"])
def test_spark_shows_an_exported_file_as_our_renderer_does(tmp_path, suffix):
    if lacking := browser.missing(MODULES):
        pytest.skip(lacking)
    cloud, path = asymmetric_cloud(), tmp_path / f"cloud{suffix}"
    write_cloud(str(path), StoredCloud(cloud.arrays()).in_axes(VIEWER_UP))
    c2w = np.eye(4)
    c2w[2, 3] = DISTANCE
    (shown,) = browser.draw_with_spark(
        path,
        [browser.Camera(c2w, FOVY)],
        SIZE,
        MODULES,
        options={"preBlurAmount": DILATION, "blurAmount": 0.0},
        rotation=browser.UNTURNED if suffix == ".spz" else browser.HALF_TURN_ABOUT_X,
    )
    ours = drawn_from_the_front(cloud)
    spark = torch.from_numpy(shown / np.float32(255))
    # Spark stores 8 bits per colour and cuts Gaussians at sqrt(8) standard deviations
    assert float(psnr(spark, ours)) > 35
    assert float(psnr(spark.flip(1), ours)) < 25  # the cloud isn't symmetric


def test_what_is_missing_is_named(tmp_path, monkeypatch):
    monkeypatch.setattr(browser, "chromium", lambda: None)
    assert "chromium" in browser.missing(tmp_path)
    monkeypatch.setattr(browser, "chromium", lambda: "/usr/bin/chromium")
    assert "@sparkjsdev/spark" in browser.missing(tmp_path)
    for name in browser.MODULES:
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    assert browser.missing(tmp_path) is None
