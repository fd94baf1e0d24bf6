"""anny-prior: the contract of priors, its options, pose and axes, and the real body."""

import sys

import numpy as np
import pytest
from PIL import Image

from tests.helpers.prior_contract import PriorContract, assert_valid
from tests.priors.cases import bvh_text, needs_anny, random_local
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors.anny import AnnyPrior, load_body


def make(**options):
    return find("anny-prior")({"num_points": 500} | options)


class TestContract(PriorContract):
    @pytest.fixture
    def make_prior(self, with_tiny_anny):
        return make


def test_the_body_stands_upright_faces_the_front_and_has_its_size(with_tiny_anny):
    cloud = make(num_points=0, pose="T", scale=1.5)("")
    low, high = cloud.points.min(axis=0), cloud.points.max(axis=0)
    assert (high - low).max() / 2 == pytest.approx(1.5)
    np.testing.assert_allclose(cloud.points.mean(axis=0), 0, atol=1e-5)
    assert np.ptp(cloud.points[:, 1]) > 0.8 * 2 * 1.5  # arms along y
    assert np.ptp(cloud.points[:, 0]) < 0.6


def test_faces_come_with_the_vertices_and_normals_with_samples(with_tiny_anny):
    assert make(num_points=0)("").faces is not None
    assert make(num_points=100)("").normals.shape == (100, 3)


def test_a_turned_pose_faces_the_front(with_tiny_anny, tmp_path):
    poses = np.zeros((2, 72))
    poses[1, 1] = np.pi / 2  # to the body's left
    np.savez(tmp_path / "a.npz", poses=poses)
    options = {"pose": str(tmp_path / "a.npz"), "num_points": 0}
    still, turned = (make(frame=frame, **options)("").points for frame in (0, 1))
    np.testing.assert_allclose(turned, still, atol=1e-5)


def test_a_bvh_and_a_person_give_other_points(with_tiny_anny, stick_body, tmp_path):
    (tmp_path / "a.bvh").write_text(bvh_text(stick_body.joints, [random_local(1)]))
    assert_valid(make(pose=str(tmp_path / "a.bvh"))(""))
    assert_valid(make(gender="female", age=0.25)(""))


def test_a_texture_colours_the_body(with_tiny_anny, tmp_path):
    Image.new("RGB", (8, 8), (255, 0, 51)).save(tmp_path / "skin.png")
    options = {"texture": str(tmp_path / "skin.png"), "color": None}
    for num_points in (0, 50):
        colors = make(num_points=num_points, **options)("").colors
        np.testing.assert_allclose(colors, np.tile([1, 0, 0.2], (len(colors), 1)), atol=1e-6)
    assert make(color=None)("").colors == pytest.approx(0.5)  # grey without one
    (tmp_path / "skin.png").write_bytes(b"\x89PNG broken")
    with pytest.raises(UserError, match="texture .*skin.png.* in none of the formats"):
        make(**options)("")
    with pytest.raises(UserError, match="texture .*does not exist"):
        make(texture="nothing.png").preflight()
    with pytest.raises(UserError, match="isn't shown with color=random: set color=null"):
        make(texture=str(tmp_path / "skin.png")).preflight()


@pytest.mark.parametrize(
    ("option", "default"), [({"frame": 1}, "0"), ({"pose_up": "z"}, "auto")], ids=str
)
def test_options_of_a_pose_file_need_one(option, default, with_tiny_anny, tmp_path):
    np.savez(tmp_path / "a.npz", poses=np.zeros((2, 66)))
    wanted = f"{next(iter(option))} has no effect with pose=T, .*: leave it at {default}"
    with pytest.raises(UserError, match=wanted):
        make(pose="T", **option)
    make(pose="T", frame=0, pose_up="auto").preflight()
    make(pose=str(tmp_path / "a.npz"), **option).preflight()


@pytest.mark.parametrize(
    ("options", "problem"),
    [
        ({"pose": "siting"}, "unknown pose 'siting': did you mean 'sitting'"),
        ({"pose": "kick"}, "unknown pose 'kick'.*'?A'?.*a .bvh file"),
        ({"gender": "femal"}, "gender: expected 'male', 'neutral', 'female' or a number"),
        ({"age": "adult"}, "age: expected 'baby'"),
        ({"age": 1.5}, "age: expected"),
        ({"age": float("nan")}, "age: expected"),
        ({"weight": -0.1}, "weight: expected a number from 0 to 1"),
        ({"frame": -1}, "frame: expected a whole number from 0"),
        ({"pose_up": "x"}, "pose_up"),
        ({"num_points": -1}, "num_points"),
        ({"muscel": 0.5}, "muscle"),
    ],
)
def test_options_are_checked_when_the_prior_is_built(options, problem):
    with pytest.raises((UserError, TypeError), match=problem):
        make(**options)


def test_preflight_reads_the_pose_before_any_long_work(with_tiny_anny, tmp_path, monkeypatch):
    AnnyPrior({"pose": "walking"}).preflight()
    with pytest.raises(UserError, match="pose file .*does not exist"):
        make(pose="nothing.bvh").preflight()
    np.savez(tmp_path / "a.npz", poses=np.zeros((1, 5)))
    with pytest.raises(UserError, match="axis-angle rotations were expected"):
        make(pose=str(tmp_path / "a.npz")).preflight()
    monkeypatch.setitem(sys.modules, "anny", None)
    with pytest.raises(UserError, match=r"this part needs anny .*\[body\]"):
        make().preflight()


@needs_anny
def test_a_real_body_walks_upright_towards_the_front():
    prior = make(
        pose="walking", num_points=4000, gender="female", age="young", color=[0.8, 0.6, 0.5]
    )
    cloud = prior("")
    assert_valid(cloud)
    height = np.ptp(cloud.points[:, 2])
    assert height == pytest.approx(2, abs=0.02) and np.ptp(cloud.points[:, 0]) < height
    feet = cloud.points[cloud.points[:, 2] < cloud.points[:, 2].min() + 0.06 * height]
    body = load_body(prior._person())
    assert len(feet) and feet[:, 0].max() > 0.2 and len(body.vertices) > 13_000
