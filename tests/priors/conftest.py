"""Fixtures of the prior tests."""

import shutil

import numpy as np
import pytest
import trimesh

from tests.helpers import tiny_3d_models as tiny
from tests.priors.motion_cases import walk
from tests.priors.priors_cases import rng
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.smpl_fit import load_body_model


@pytest.fixture(scope="session")
def bodies(tmp_path_factory):
    return tmp_path_factory.mktemp("bodies")


@pytest.fixture(scope="session")
def body_file(bodies):
    return tiny.body_model(bodies / "SMPL_NEUTRAL.npz")


@pytest.fixture(scope="session")
def body(body_file):
    return load_body_model(str(body_file))


@pytest.fixture(scope="session")
def motion_file(bodies, body):
    """Write two motions in MDM's layout, the second shorter and walking backwards."""
    forward = walk(body).transpose(1, 2, 0)
    np.savez(
        bodies / "results.npz",
        motion=np.stack([forward, forward[..., ::-1]]),
        text=np.array(["Someone kicks"] * 2),
        lengths=np.array([6, 4]),
    )
    return bodies / "results.npz"


@pytest.fixture(scope="session")
def assets(tmp_path_factory):
    """Write small sources: a body-like capsule, a coloured mesh, points and Gaussians."""
    folder = tmp_path_factory.mktemp("assets")
    body = trimesh.creation.capsule(height=1.0, radius=0.3)  # along z
    body.apply_transform(
        trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
    )  # now along y, as OBJ has it
    body.export(folder / "body.obj")
    box = trimesh.creation.box(extents=[2, 1, 0.5]).subdivide().subdivide()
    box.visual.vertex_colors = (255 * (box.vertices / 2 + 0.5).clip(0, 1)).astype(np.uint8)
    box.export(folder / "box.ply")
    ply.write_points(
        folder / "points.ply",
        PointCloud(points=rng(1).normal(size=(300, 3)), colors=rng(2).random((300, 3))),
    )
    harmonics, scales, turns = (rng(i).normal(size=(200, n)) for i, n in ((3, 12), (4, 3), (5, 4)))
    gaussians = Gaussians(
        means=rng(6).normal(size=(200, 3)),
        quats=turns,
        log_scales=scales,
        logit_opacities=np.linspace(-5, 5, 200),
        sh=harmonics.reshape(200, 4, 3),
    )
    ply.write_gaussians(folder / "gaussians.ply", gaussians, ["up: z"])
    return folder


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Write a tiny Shap-E in the published format."""
    return tiny.shap_e(tmp_path_factory.mktemp("models") / "shap-e")


@pytest.fixture
def copy(folder, tmp_path):
    """Return a copy of the tiny Shap-E whose files a test may change."""
    return shutil.copytree(folder, tmp_path / "copy")
