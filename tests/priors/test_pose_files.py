"""Files of poses: the layouts of axis-angle rotations, their axes, and damage."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.priors.pose_cases import bvh_text, limb_angles, random_local, walked
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.body_pose import INDEX, named_pose, posed
from threestudio_gaussiandreamer.priors.pose_files import read_axis_angles, read_pose
from threestudio_gaussiandreamer.priors.skeleton import BODY_JOINTS

FRAMES = 5


@pytest.fixture
def angles():
    """Rotations of 52 joints in all frames."""
    return np.random.default_rng(0).normal(scale=0.4, size=(FRAMES, 52, 3))


def saved(tmp_path, **arrays):
    np.savez(tmp_path / "pose.npz", **arrays)
    return tmp_path / "pose.npz"


def layouts(angles):
    """Yield arrays of an NPZ, or the array of an NPY, with the joints of each."""
    flat = angles.reshape(FRAMES, -1)
    yield {"poses": flat}
    yield {"poses": np.concatenate([flat, np.zeros((FRAMES, 9))], 1)}  # SMPL-X: 55 joints
    yield {"global_orient": angles[:, 0], "body_pose": flat[:, 3:66]}
    yield {"global_orient": angles[:, :1], "body_pose": angles[:, 1:24]}
    yield flat[:, :72]
    yield angles[:, :22].astype(np.float32)


@pytest.mark.parametrize("layout", range(6))
def test_all_layouts_give_the_rotations_of_the_body(layout, angles, tmp_path):
    content = list(layouts(angles))[layout]
    path = tmp_path / ("pose.npz" if isinstance(content, dict) else "pose.npy")
    if isinstance(content, dict):
        np.savez(path, **content)
    else:
        np.save(path, content)
    found, up = read_axis_angles(path, 1)
    wanted = Rotation.from_rotvec(angles[1, :BODY_JOINTS]).as_matrix()
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert up == "y"


@pytest.mark.parametrize("shape", [(66,), (22, 3), (1, 72)])
def test_a_single_frame_needs_no_dimension(shape, angles, tmp_path):
    one = angles[0].reshape(-1)[: np.prod(shape)].reshape(shape)
    np.save(tmp_path / "pose.npy", one)
    found, _ = read_axis_angles(tmp_path / "pose.npy", 0)
    wanted = Rotation.from_rotvec(angles[0, :BODY_JOINTS]).as_matrix()
    np.testing.assert_allclose(found, wanted, atol=1e-9)


@pytest.mark.parametrize("frames", [1, 2, 3, 4, 21, 22])
@pytest.mark.parametrize("root", [(3,), (1, 3)], ids=str)
@pytest.mark.parametrize("body", [(63,), (21, 3), (69,), (23, 3)], ids=str)
def test_body_poses_have_any_number_of_frames(frames, root, body, tmp_path):
    """Also as many frames as joints."""
    angles = np.random.default_rng(1).normal(scale=0.4, size=(frames, 24, 3))
    joints = np.prod(body) // 3
    path = saved(
        tmp_path,
        global_orient=angles[:, 0].reshape(frames, *root),
        body_pose=angles[:, 1 : joints + 1].reshape(frames, *body),
    )
    found, _ = read_axis_angles(path, frames - 1)
    wanted = Rotation.from_rotvec(angles[-1, :BODY_JOINTS]).as_matrix()
    np.testing.assert_allclose(found, wanted, atol=1e-9)


@pytest.mark.parametrize("root", [(3,), (1, 3), (1, 1, 3)], ids=str)
@pytest.mark.parametrize("body", [(63,), (21, 3), (1, 63), (1, 21, 3)], ids=str)
def test_a_single_body_pose_needs_no_dimension(root, body, angles, tmp_path):
    path = saved(
        tmp_path,
        global_orient=angles[0, 0].reshape(root),
        body_pose=angles[0, 1:BODY_JOINTS].reshape(body),
    )
    found, _ = read_axis_angles(path, 0)
    wanted = Rotation.from_rotvec(angles[0, :BODY_JOINTS]).as_matrix()
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_a_body_pose_alone_stands_upright(angles, tmp_path):
    found, _ = read_axis_angles(saved(tmp_path, body_pose=angles[0, 1:22].reshape(-1)), 0)
    np.testing.assert_array_equal(found[0], np.eye(3))


def test_amass_has_z_up(stick_body, tmp_path):
    """Its resting body is turned from y up to z up by its first rotation."""
    poses = np.zeros((1, 156))
    poses[0, 0] = np.pi / 2
    path = saved(tmp_path, poses=poses, mocap_framerate=np.array(120.0))
    wanted = named_pose(stick_body, "T")
    np.testing.assert_allclose(read_pose(str(path), stick_body), wanted, atol=1e-9)
    lying = posed(stick_body, read_pose(str(path), stick_body, up="y")).joints
    assert np.ptp(lying[:, 1]) < 0.3 < np.ptp(lying[:, 2])


@pytest.mark.parametrize("up", ["auto", "z", "-y"])
def test_a_bvh_gives_the_body_its_pose(up, stick_body, tmp_path):
    local = random_local(4, 20)
    turns = {"z": [np.pi / 2, 0, 0], "-y": [np.pi, 0, 0], "auto": [0, 0, 0]}
    local[0] = Rotation.from_rotvec(turns[up]).as_matrix()
    path = tmp_path / "a.bvh"
    path.write_text(bvh_text(stick_body.joints, [local]))
    found = posed(stick_body, read_pose(str(path), stick_body, up=up)).joints
    local[0] = np.eye(3)
    assert limb_angles(found, walked(stick_body.joints, local)).max() < 1e-4
    assert found[INDEX["head"], 1] > found[INDEX["left ankle"], 1] + 0.5


@pytest.mark.parametrize(
    ("arrays", "problem"),
    [
        ({"poses": np.zeros((2, 70))}, r"holds an array \(2, 70\) of float64: axis-angle"),
        ({"poses": np.zeros((2, 22, 3, 3))}, "matrices aren't read"),
        ({"poses": np.zeros((0, 72))}, r"holds an array \(0, 72\)"),
        ({"poses": np.full((1, 72), np.nan)}, "NaN or infinite in frame 0"),
        ({"poses": np.array([["a"] * 72])}, "holds an array"),
        ({"poses": np.zeros((1, 72), complex)}, "holds an array"),
        ({"poses": np.full((1, 72), 1e300)}, "too large"),
        ({"trans": np.zeros((1, 3))}, "neither an array 'poses' nor 'body_pose'"),
        ({"body_pose": np.zeros((2, 63)), "global_orient": np.zeros((3, 3))}, "global_orient"),
        ({"body_pose": np.zeros((0, 63))}, r"holds an array \(0, 66\)"),
        ({"body_pose": np.zeros((0, 63)), "global_orient": np.zeros((0, 3))}, "holds an array"),
        ({"body_pose": np.zeros((3, 63)), "global_orient": np.zeros(9)}, "global_orient"),
        ({"body_pose": np.zeros((4, 63)), "global_orient": np.zeros((2, 6))}, "global_orient"),
        ({"body_pose": np.zeros((2, 63)), "global_orient": np.zeros((2, 3, 3))}, "global_orient"),
        ({"body_pose": np.zeros((2, 60)), "global_orient": np.zeros((2, 3))}, "holds an array"),
    ],
)
def test_wrong_arrays_are_refused(arrays, problem, stick_body, tmp_path):
    with pytest.raises(UserError, match=problem):
        read_pose(str(saved(tmp_path, **arrays)), stick_body)


def test_a_frame_beyond_the_end_is_refused(stick_body, angles, tmp_path):
    path = saved(tmp_path, poses=angles.reshape(FRAMES, -1))
    with pytest.raises(UserError, match="has 5 frames, numbered from 0; there is no 5"):
        read_pose(str(path), stick_body, frame=FRAMES)


def test_missing_and_unknown_files_are_refused(stick_body, tmp_path):
    with pytest.raises(UserError, match="does not exist"):
        read_pose(str(tmp_path / "a.bvh"), stick_body)
    (tmp_path / "a.fbx").touch()
    with pytest.raises(UserError, match=r"format of the pose file .*\.fbx"):
        read_pose(str(tmp_path / "a.fbx"), stick_body)
    np.save(tmp_path / "a.npy", np.array([{}], object), allow_pickle=True)
    with pytest.raises(UserError, match="has no array 'poses'"):
        read_pose(str(tmp_path / "a.npy"), stick_body)
