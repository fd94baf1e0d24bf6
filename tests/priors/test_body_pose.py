"""Poses of a body: named ones, rotations of SMPL's joints, positions of another skeleton; and files
of poses in many layouts, BVH by many programs, and damage.
"""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from tests.priors.cases import MIXAMO, bvh_text, limb_angles, random_local, rng, walked
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.body_pose import (
    BODY_JOINTS,
    INDEX,
    JOINTS,
    NEEDED,
    Body,
    joint_names,
    named_pose,
    part_frame,
    pose_of_positions,
    pose_of_rotations,
    posed,
    read_axis_angles,
    read_bvh,
    read_pose,
    swing,
)

REST = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))


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


def test_rotations_move_the_joints_of_a_t_pose_as_forward_kinematics_says(stick_body):
    in_t_pose = stick_body._replace(joints=posed(stick_body, named_pose(stick_body, "T")).joints)
    for seed in range(3):
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
    upright = {name: stick_body.joints[INDEX[name]] for name in NEEDED}  # alone they give a pose
    np.testing.assert_allclose(pose_of_positions(stick_body, upright), REST, atol=1e-9)
    with pytest.raises(UserError, match="hips and spine on one line"):
        pose_of_positions(stick_body, dict.fromkeys(NEEDED, np.zeros(3)))


def test_vertices_move_rigidly_with_the_joint_that_owns_them(stick_body):
    turn = Rotation.from_rotvec([0.3, -0.4, 0.9]).as_matrix()
    elbow, wrist, local = INDEX["left elbow"], INDEX["left wrist"], REST.copy()
    local[elbow] = turn
    before = posed(stick_body, named_pose(stick_body, "T"))
    after = posed(stick_body, pose_of_rotations(stick_body, local))
    owned = stick_body.weights[:, elbow] > 0.5
    wanted = before.joints[elbow] + (before.vertices[owned] - before.joints[elbow]) @ turn.T
    np.testing.assert_allclose(after.vertices[owned], wanted, atol=1e-9)
    kept = stick_body.weights[:, elbow] + stick_body.weights[:, wrist] == 0
    np.testing.assert_allclose(after.vertices[kept], before.vertices[kept], atol=1e-12)
    weights, none = np.zeros((1, BODY_JOINTS)), np.zeros((0, 3), np.int64)
    weights[0, :2] = 0.25, 0.75  # a blend of weights is the blend of the motions
    body, pose = Body(np.array([[1.0, 0, 0]]), none, np.zeros((22, 3)), weights), REST.copy()
    pose[1] = Rotation.from_rotvec([0, 0, np.pi / 2]).as_matrix()
    np.testing.assert_allclose(posed(body, pose).vertices, [[0.25, 0.75, 0]], atol=1e-12)


def test_the_smallest_rotation_between_directions():
    for target in ((0, 0, 2.0), (-3.0, 0, 0), (1e-3, 0, 0), (1.0, 2.0, 3.0)):
        rotation = swing(np.array([1.0, 0, 0]), np.array(target))
        np.testing.assert_allclose(rotation[:, 0], target / np.linalg.norm(target), atol=1e-9)
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-9)
        assert np.linalg.det(rotation) == pytest.approx(1)


# Files of rotations -------------------------------------------------------------------------------

FRAMES = 5
ANGLES = rng().normal(scale=0.4, size=(FRAMES, 52, 3))
"""Rotations of 52 joints in all frames."""
FLAT = ANGLES.reshape(FRAMES, -1)


def saved(folder, content):
    """Write the arrays of an NPZ, or that of an NPY."""
    path = folder / ("pose.npz" if isinstance(content, dict) else "pose.npy")
    np.savez(path, **content) if isinstance(content, dict) else np.save(path, content)
    return path


def of_frames(count, root, body):
    """Return the same rotations as smplx's arguments; ``count`` 0 leaves the frames out."""
    frames, joints = (count,) if count else (), np.prod(body) // 3
    rows = ANGLES[:count] if count else ANGLES[0]
    return {
        "global_orient": rows[..., 0, :].reshape(*frames, *root),
        "body_pose": rows[..., 1 : joints + 1, :].reshape(*frames, *body),
    }


@pytest.mark.parametrize(
    ("content", "frame"),
    [
        ({"poses": FLAT}, 1),
        ({"poses": np.concatenate([FLAT, np.zeros((FRAMES, 9))], 1)}, 1),  # SMPL-X: 55 joints
        (FLAT[:, :72], 1),
        (ANGLES[:, :22].astype(np.float32), 1),
        (FLAT[0, :66], 0),
        (ANGLES[0, :22], 0),
        *((of_frames(FRAMES, (3,), body), FRAMES - 1) for body in ((63,), (21, 3), (69,), (23, 3))),
        (of_frames(FRAMES, (1, 3), (63,)), FRAMES - 1),
        (of_frames(1, (3,), (63,)), 0),
        (of_frames(0, (1, 1, 3), (1, 21, 3)), 0),
    ],
)
def test_all_layouts_give_the_rotations_of_the_body(content, frame, tmp_path):
    found, up = read_axis_angles(saved(tmp_path, content), frame)
    wanted = Rotation.from_rotvec(ANGLES[frame, :BODY_JOINTS]).as_matrix()
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    assert up == "y"


def test_as_many_frames_as_joints_no_root_and_amass(stick_body, tmp_path):
    angles = rng(1).normal(scale=0.4, size=(21, 22, 3))
    arrays = {"global_orient": angles[:, 0], "body_pose": angles[:, 1:]}
    found, _ = read_axis_angles(saved(tmp_path, arrays), 20)
    np.testing.assert_allclose(found, Rotation.from_rotvec(angles[20]).as_matrix(), atol=1e-9)
    alone, _ = read_axis_angles(saved(tmp_path, {"body_pose": FLAT[0, 3:66]}), 0)
    np.testing.assert_array_equal(alone[0], np.eye(3))
    poses = np.zeros((1, 156))
    poses[0, 0] = np.pi / 2  # AMASS's resting body is turned from y up to z up
    path = saved(tmp_path, {"poses": poses, "mocap_framerate": np.array(120.0)})
    wanted = named_pose(stick_body, "T")
    np.testing.assert_allclose(read_pose(str(path), stick_body), wanted, atol=1e-9)
    with pytest.raises(UserError, match="has 1 frames?, numbered from 0; there is no 1"):
        read_pose(str(path), stick_body, frame=1)
    lying = posed(stick_body, read_pose(str(path), stick_body, up="y")).joints
    assert np.ptp(lying[:, 1]) < 0.3 < np.ptp(lying[:, 2])


WRONG = "axis-angle rotations were expected"


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        ({"poses": np.zeros((2, 70))}, rf"has poses \(2, 70\) of float64: {WRONG}"),
        ({"poses": np.zeros((2, 22, 3, 3))}, "matrices aren't read"),
        ({"poses": np.zeros((0, 72))}, WRONG),
        ({"poses": np.full((1, 72), np.nan)}, "NaN or infinite in frame 0"),
        ({"poses": np.full((1, 72), 1e300)}, "too large"),
        ({"trans": np.zeros((1, 3))}, "it has neither poses nor body_pose"),
        ({"body_pose": np.zeros((2, 63)), "global_orient": np.zeros((3, 3))}, "global_orient"),
        ({"body_pose": np.zeros((4, 63)), "global_orient": np.zeros((2, 6))}, "global_orient"),
        (np.array([{}], object), "has no array 'poses'"),
    ],
)
def test_wrong_arrays_are_refused(content, problem, stick_body, tmp_path):
    with pytest.raises(UserError, match=problem):
        read_pose(str(saved(tmp_path, content)), stick_body)


# BVH ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("up", ["auto", "z", "-y"])
def test_a_bvh_gives_the_body_its_pose(up, stick_body, tmp_path):
    local = random_local(4, 20)
    turns = {"z": [np.pi / 2, 0, 0], "-y": [np.pi, 0, 0], "auto": [0, 0, 0]}
    local[0] = Rotation.from_rotvec(turns[up]).as_matrix()
    path = tmp_path / "a.bvh"
    path.write_text(bvh_text(stick_body.joints, [random_local(0), local]))
    found = posed(stick_body, read_pose(str(path), stick_body, frame=1, up=up)).joints
    local[0] = np.eye(3)
    assert limb_angles(found, walked(stick_body.joints, local)).max() < 1e-4
    assert found[INDEX["head"], 1] > found[INDEX["left ankle"], 1] + 0.5


PROGRAMS = {
    "CMU": (
        "Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase RHipJoint RightUpLeg RightLeg "
        "RightFoot RightToeBase LowerBack Spine Spine1 Neck Neck1 Head LeftShoulder LeftArm "
        "LeftForeArm LeftHand LeftFingerBase LThumb RightShoulder RightArm RightForeArm RightHand",
        {"left hip": "LeftUpLeg", "left shoulder": "LeftArm", "left foot": "LeftToeBase"},
    ),
    "Biovision": (
        "Hips LeftHip LeftKnee LeftAnkle RightHip RightKnee RightAnkle Chest LeftCollar "
        "LeftShoulder LeftElbow LeftWrist RightCollar RightShoulder RightElbow RightWrist Head",
        {"left hip": "LeftHip", "left shoulder": "LeftShoulder", "right wrist": "RightWrist"},
    ),
    "DAZ": (
        "hip abdomen chest neck head lCollar lShldr lForeArm lHand rCollar rShldr rForeArm rHand "
        "lThigh lShin lFoot rThigh rShin rFoot",
        {"pelvis": "hip", "left shoulder": "lShldr", "right knee": "rShin"},
    ),
    "SMPL": (
        "pelvis left_hip left_knee left_ankle left_foot right_hip right_knee right_ankle spine1 "
        "neck head left_collar left_shoulder left_elbow left_wrist left_hand right_shoulder "
        "right_elbow",
        {"left ankle": "left_ankle", "left foot": "left_foot", "left wrist": "left_wrist"},
    ),
    "Rigify": (
        "root spine thigh.L shin.L foot.L toe.L thigh.R shin.R foot.R neck head shoulder.L "
        "upper_arm.L forearm.L hand.L upper_arm.R forearm.R hand.R",
        {"left shoulder": "upper_arm.L", "left foot": "toe.L"},
    ),
    "MakeHuman": (
        "root spine05 upperleg01.L lowerleg01.L foot.L upperleg01.R lowerleg01.R foot.R neck01 "
        "head clavicle.L shoulder01.L upperarm01.L lowerarm01.L wrist.L upperarm01.R lowerarm01.R",
        {"left shoulder": "upperarm01.L", "neck": "neck01"},
    ),
    "Biped": (
        ",".join(
            f"Bip01 {name}"
            for name in "Pelvis,Spine,L Thigh,L Calf,L Foot,R Thigh,R Calf,R Foot,Neck,Head,"
            "L Clavicle,L UpperArm,L Forearm,L Hand,R UpperArm,R Forearm".split(",")
        ),
        {"pelvis": "Bip01 Pelvis", "left shoulder": "Bip01 L UpperArm"},
    ),
    "Mixamo": (
        " ".join(f"mixamorig:{name}" for name in MIXAMO),
        {"left shoulder": "mixamorig:LeftArm", "lower spine": "mixamorig:Spine"},
    ),
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_joints_are_found_by_the_names_of_many_programs(program):
    text, wanted = PROGRAMS[program]
    names = text.split("," if "," in text else None)
    found = {joint: names[number] for joint, number in joint_names(names).items()}
    assert found | wanted == found and set(wanted) <= set(JOINTS)
    assert len(set(found.values())) == len(found)


def joint(name, offset, *inside, kind="JOINT", channels="3 Zrotation Xrotation Yrotation"):
    lines = [f"{kind} {name}", "{", f"OFFSET {offset}", f"CHANNELS {channels}", *inside, "}"]
    return "\n".join(lines)


OTHERS = "RightUpLeg RightLeg LeftArm LeftForeArm RightArm RightForeArm".split()
CASE = "\n".join([
    "HIERARCHY",
    joint(
        "Hips", "0 0 0",
        joint("LeftUpLeg", "10 0 0", joint("LeftLeg", "0 -40 0", "End Site\n{\nOFFSET 0 -4 0\n}")),
        *(joint(name, "0 1 0", channels="1 Yrotation") for name in OTHERS),
        kind="ROOT", channels="6 Xposition Yposition Zposition Zrotation Xrotation Yrotation",
    ),
    "MOTION\nFrames: 2\nFrame Time: 0.0333",
    "1 90 2 0 0 0" + " 0" * 12,
    "1 90 2 0 0 90 0 -90 0" + " 0" * 9,
])  # fmt: skip


def test_positions_follow_the_rotations(tmp_path):
    """The hips turn by 90 degrees about y (x becomes -z), the leg swings forwards about its x."""
    path = tmp_path / "chain.bvh"
    path.write_text(CASE.replace("ROOT", "{\n}\nROOT", 1))  # braces before the root are ignored
    still, moved = read_bvh(path, 0), read_bvh(path, 1)
    np.testing.assert_allclose(still["left hip"], [11, 90, 2], atol=1e-9)
    np.testing.assert_allclose(still["left knee"], [11, 50, 2], atol=1e-9)
    np.testing.assert_allclose(moved["left hip"], [1, 90, -8], atol=1e-9)
    np.testing.assert_allclose(moved["left knee"], [41, 90, -8], atol=1e-9)
    with pytest.raises(UserError, match="has 2 frames, numbered from 0; there is no 2"):
        read_bvh(path, 2)


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("LeftLeg", "Tentacle", "no joint that is known as the left knee: its joints are Hips"),
        ("Frames: 2", "Frames: 2\n1 2 3", "(12|18) finite numbers were expected"),
        ("1 90 2 0 0 0", "1 90 nan 0 0 0", "finite numbers were expected in the line '1 90 nan"),
        ("OFFSET 10 0 0", "OFFSET 10 zero 0", "3 finite numbers were expected"),
        ("6 Xposition", "6 Xpositoin", "channels Xpositoin.*expected different ones of Xposition"),
        ("6 Xposition Yposition", "6 Xposition Xposition", "expected different ones of"),
        ("OFFSET 10 0 0", "OFFSET 1e300 0 0", "3 finite numbers were expected"),
        ("HIERARCHY\nROOT Hips\n{", "HIERARCHY\nROOT Hips\n{\n{", "is cut off"),
        (CASE, "\x00\xff binary", "has no joints"),
    ],
)
def test_damaged_files_are_refused(stick_body, tmp_path, old, new, problem):
    assert old in CASE
    (tmp_path / "chain.bvh").write_text(CASE.replace(old, new, 1))
    with pytest.raises(UserError, match=f"pose file .*chain.bvh': .*{problem}"):
        read_pose(str(tmp_path / "chain.bvh"), stick_body)
