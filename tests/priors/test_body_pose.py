"""Poses of a body: named ones, rotations of SMPL's joints, and positions of another skeleton."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.priors.cases import limb_angles, needs_anny, random_local, walked
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.body_pose import (
    BODY_JOINTS,
    INDEX,
    JOINTS,
    NEEDED,
    POSES,
    Body,
    named_pose,
    part_frame,
    pose_of_positions,
    pose_of_rotations,
    posed,
    swing,
)


def direction(joints, start, end):
    bone = joints[INDEX[end]] - joints[INDEX[start]]
    return bone / np.linalg.norm(bone)


def test_limbs_point_where_the_named_poses_say(stick_body):
    for name, down in (("T", 0.0), ("A", np.sin(np.pi / 4))):
        joints = posed(stick_body, named_pose(stick_body, name)).joints
        for side, sign in (("left", 1), ("right", -1)):
            for start, end in (("shoulder", "elbow"), ("elbow", "wrist")):
                found = direction(joints, f"{side} {start}", f"{side} {end}")
                across = sign * np.sqrt(1 - down**2)
                np.testing.assert_allclose(found, [across, -down, 0], atol=1e-9)
    joints = posed(stick_body, named_pose(stick_body, "sitting")).joints
    for side in ("left", "right"):
        assert direction(joints, f"{side} hip", f"{side} knee")[2] > 0.95
        assert direction(joints, f"{side} knee", f"{side} ankle")[1] < -0.95
    joints = posed(stick_body, named_pose(stick_body, "walking")).joints
    ahead = {name: joints[INDEX[name], 2] for name in INDEX}
    assert ahead["left ankle"] > 0.2 > -0.2 > ahead["right ankle"]
    assert ahead["left wrist"] < 0 < ahead["right wrist"]


@pytest.mark.parametrize("seed", range(3))
def test_rotations_move_the_joints_of_a_t_pose_as_forward_kinematics_says(stick_body, seed):
    in_t_pose = stick_body._replace(joints=posed(stick_body, named_pose(stick_body, "T")).joints)
    local = random_local(seed)
    found = posed(stick_body, pose_of_rotations(stick_body, local)).joints
    np.testing.assert_allclose(found, walked(in_t_pose.joints, local), atol=1e-9)


@pytest.mark.parametrize(("seed", "size"), [(0, 1.0), (1, 170.0)])
def test_positions_of_any_unit_give_limbs_their_directions(stick_body, seed, size):
    wanted = walked(stick_body.joints, random_local(seed, 25)) * size
    positions = {name: wanted[number] for name, number in INDEX.items()}
    found = posed(stick_body, pose_of_positions(stick_body, positions)).joints
    assert limb_angles(found, wanted).max() < 1e-4
    for part in ("hip", "shoulder"):
        have = {name: found[number] for name, number in INDEX.items()}
        across = (part_frame(p, part)[:, 0] for p in (positions, have))
        np.testing.assert_allclose(*across, atol=0.2)


def test_the_needed_positions_alone_give_a_pose(stick_body):
    upright = {name: stick_body.joints[INDEX[name]] for name in NEEDED}
    pose = pose_of_positions(stick_body, upright)
    np.testing.assert_allclose(pose, np.tile(np.eye(3), (BODY_JOINTS, 1, 1)), atol=1e-9)
    with pytest.raises(UserError, match="hips and spine on one line"):
        pose_of_positions(stick_body, dict.fromkeys(NEEDED, np.zeros(3)))


def test_vertices_move_rigidly_with_the_joint_that_owns_them(stick_body):
    turn = Rotation.from_rotvec([0.3, -0.4, 0.9]).as_matrix()
    local = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))
    local[INDEX["left elbow"]] = turn
    before = posed(stick_body, named_pose(stick_body, "T"))
    after = posed(stick_body, pose_of_rotations(stick_body, local))
    owned = stick_body.weights[:, INDEX["left elbow"]] > 0.5
    elbow = before.joints[INDEX["left elbow"]]
    wanted = elbow + (before.vertices[owned] - elbow) @ turn.T
    np.testing.assert_allclose(after.vertices[owned], wanted, atol=1e-9)
    still = stick_body.weights[:, INDEX["left elbow"]] + stick_body.weights[:, INDEX["left wrist"]]
    kept = still == 0
    np.testing.assert_allclose(after.vertices[kept], before.vertices[kept], atol=1e-12)


def test_a_blend_of_weights_is_the_blend_of_the_motions():
    joints = np.zeros((BODY_JOINTS, 3))
    weights = np.zeros((1, BODY_JOINTS))
    weights[0, :2] = 0.25, 0.75
    none = np.zeros((0, 3), np.int64)
    body = Body(np.array([[1.0, 0, 0]]), none, np.zeros((0, 2)), none, joints, weights)
    pose = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))
    pose[1] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    np.testing.assert_allclose(posed(body, pose).vertices, [[0.25, 0.75, 0]], atol=1e-12)


@pytest.mark.parametrize("target", [(0, 0, 2.0), (-3.0, 0, 0), (1e-3, 0, 0), (1.0, 2.0, 3.0)])
def test_the_smallest_rotation_between_directions(target):
    rotation = swing(np.array([1.0, 0, 0]), np.array(target))
    found = rotation @ [1, 0, 0]
    np.testing.assert_allclose(found, np.array(target) / np.linalg.norm(target), atol=1e-9)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(swing(np.zeros(3), np.ones(3)), np.eye(3))


@needs_anny
@pytest.mark.parametrize("name", POSES)
def test_a_real_body_keeps_its_bones_and_stands_upright(name, real_body):
    found = posed(real_body, named_pose(real_body, name))
    top, low = found.vertices[:, 1].argmax(), found.vertices[:, 1].argmin()
    feet = [INDEX[f"{side} {part}"] for side in ("left", "right") for part in ("ankle", "foot")]
    assert real_body.weights[top, JOINTS.index("head")] > 0.9
    assert real_body.weights[low, feet].sum() > 0.9
    before, after = (
        np.linalg.norm(joints[INDEX["left elbow"]] - joints[INDEX["left shoulder"]])
        for joints in (real_body.joints, found.joints)
    )
    assert before == pytest.approx(after)
