"""BVH files: names of joints, forward kinematics, and damage."""

from pathlib import Path

import numpy as np
import pytest

from tests.priors.pose_cases import MIXAMO, bvh_text, limb_angles, random_local, walked
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors.body_pose import INDEX
from threestudio_gaussiandreamer.priors.pose_files import joint_names, read_bvh, split_name
from threestudio_gaussiandreamer.priors.skeleton import JOINTS

CMU = (
    "Hips LHipJoint LeftUpLeg LeftLeg LeftFoot LeftToeBase RHipJoint RightUpLeg RightLeg RightFoot "
    "RightToeBase LowerBack Spine Spine1 Neck Neck1 Head LeftShoulder LeftArm LeftForeArm LeftHand "
    "LeftFingerBase LThumb RightShoulder RightArm RightForeArm RightHand"
)
BIOVISION = (
    "Hips LeftHip LeftKnee LeftAnkle RightHip RightKnee RightAnkle Chest LeftCollar LeftShoulder "
    "LeftElbow LeftWrist RightCollar RightShoulder RightElbow RightWrist Neck Head"
)
DAZ = (
    "hip abdomen chest neck head lCollar lShldr lForeArm lHand rCollar rShldr rForeArm rHand "
    "lThigh lShin lFoot rThigh rShin rFoot"
)
SMPL = (
    "pelvis left_hip left_knee left_ankle left_foot right_hip right_knee right_ankle spine1 neck "
    "head left_collar left_shoulder left_elbow left_wrist left_hand right_shoulder right_elbow"
)
RIGIFY = (
    "root spine thigh.L shin.L foot.L toe.L thigh.R shin.R foot.R neck head shoulder.L upper_arm.L "
    "forearm.L hand.L upper_arm.R forearm.R hand.R"
)
MAKEHUMAN = (
    "root spine05 upperleg01.L lowerleg01.L foot.L upperleg01.R lowerleg01.R foot.R neck01 head "
    "clavicle.L shoulder01.L upperarm01.L lowerarm01.L wrist.L upperarm01.R lowerarm01.R wrist.R"
)
BIPED = (
    "Pelvis,Spine,L Thigh,L Calf,L Foot,R Thigh,R Calf,R Foot,Neck,Head,L Clavicle,L UpperArm,"
    "L Forearm,L Hand,R UpperArm,R Forearm"
)
EXPECTED = {
    "CMU": (CMU.split(), {"left hip": "LeftUpLeg", "left shoulder": "LeftArm",
                          "left ankle": "LeftFoot", "left foot": "LeftToeBase"}),
    "Biovision": (BIOVISION.split(), {"left hip": "LeftHip", "left shoulder": "LeftShoulder",
                                      "right wrist": "RightWrist"}),
    "DAZ": (DAZ.split(), {"pelvis": "hip", "left shoulder": "lShldr", "right knee": "rShin"}),
    "SMPL": (SMPL.split(), {"left ankle": "left_ankle", "left foot": "left_foot",
                            "left wrist": "left_wrist", "right elbow": "right_elbow"}),
    "Rigify": (RIGIFY.split(), {"left shoulder": "upper_arm.L", "left foot": "toe.L"}),
    "MakeHuman": (MAKEHUMAN.split(), {"left shoulder": "upperarm01.L", "neck": "neck01"}),
    "Biped": ([f"Bip01 {name}" for name in BIPED.split(",")],
              {"pelvis": "Bip01 Pelvis", "left shoulder": "Bip01 L UpperArm"}),
    "Mixamo": ([f"mixamorig:{name}" for name in MIXAMO],
               {"left shoulder": "mixamorig:LeftArm", "lower spine": "mixamorig:Spine"}),
}  # fmt: skip


@pytest.mark.parametrize("program", EXPECTED)
def test_joints_are_found_by_the_names_of_many_programs(program):
    names, wanted = EXPECTED[program]
    found = {joint: names[number] for joint, number in joint_names(names, Path("a.bvh")).items()}
    assert found | wanted == found
    assert len(set(found.values())) == len(found)


@pytest.mark.parametrize(
    ("name", "wanted"),
    [
        ("LeftUpLeg", ("left", "upleg")),
        ("lShldr", ("left", "shldr")),
        ("righthand", ("right", "hand")),
        ("upperleg01.L", ("left", "upperleg1")),
        ("Spine1", ("", "spine1")),
        ("", ("", "")),
    ],
)
def test_a_name_has_a_side_and_a_part(name, wanted):
    assert split_name(name) == wanted


CHAIN = """HIERARCHY
ROOT Hips
{
  OFFSET 0 0 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT LeftUpLeg
  {
    OFFSET 10 0 0
    CHANNELS 3 Zrotation Xrotation Yrotation
    JOINT LeftLeg
    {
      OFFSET 0 -40 0
      CHANNELS 3 Zrotation Xrotation Yrotation
      End Site
      {
        OFFSET 0 -40 0
      }
    }
  }
%s}
MOTION
Frames: 2
Frame Time: 0.0333
1 90 2 0 0 0 0 0 0 0 0 0%s
1 90 2 0 0 90 0 -90 0 0 0 0%s
"""
OTHERS = "RightUpLeg RightLeg LeftArm LeftForeArm RightArm RightForeArm".split()
CASE = CHAIN % (
    "".join(f"JOINT {name}\n{{\nOFFSET 0 1 0\nCHANNELS 1 Yrotation\n}}\n" for name in OTHERS),
    *(2 * [" 0" * len(OTHERS)]),
)


@pytest.fixture
def chain(tmp_path):
    path = tmp_path / "chain.bvh"
    path.write_text(CASE)
    return path


def test_positions_follow_the_rotations(chain):
    """The hips turn by 90 degrees about y (x becomes -z), the leg swings forwards about its x."""
    still, moved = read_bvh(chain, 0), read_bvh(chain, 1)
    np.testing.assert_allclose(still["left hip"], [11, 90, 2], atol=1e-9)
    np.testing.assert_allclose(still["left knee"], [11, 50, 2], atol=1e-9)
    np.testing.assert_allclose(moved["left hip"], [1, 90, -8], atol=1e-9)
    np.testing.assert_allclose(moved["left knee"], [41, 90, -8], atol=1e-9)


@pytest.mark.parametrize("seed", range(2))
def test_a_written_skeleton_is_read_back(seed, stick_body, tmp_path):
    local = [random_local(seed), random_local(seed + 10)]
    path = tmp_path / "a.bvh"
    path.write_text(bvh_text(stick_body.joints, local))
    found = read_bvh(path, 1)
    wanted = walked(stick_body.joints, local[1])
    joints = np.array([found.get(name, np.full(3, np.nan)) for name in INDEX])
    assert limb_angles(joints, wanted).max() < 1e-4
    lengths = [np.linalg.norm(j[INDEX["head"]] - j[INDEX["neck"]]) for j in (joints, wanted)]
    assert lengths[0] == pytest.approx(100 * lengths[1])


@pytest.mark.parametrize(
    ("old", "new", "problem"),
    [
        ("LeftLeg", "Tentacle", "no joint that is known as the left knee: its joints are Hips"),
        ("Frames: 2", "Frames: 2\n1 2 3", "12|18 finite numbers were expected"),
        ("1 90 2 0 0 0", "1 90 nan 0 0 0", "finite numbers were expected in the line '1 90 nan"),
        ("OFFSET 10 0 0", "OFFSET 10 0", "3 finite numbers were expected"),
        ("OFFSET 10 0 0", "OFFSET 10 zero 0", "3 finite numbers were expected"),
        ("6 Xposition", "6 Xpositoin", "did you mean 'Xposition'"),
        ("6 Xposition Yposition", "6 Xposition Xposition", "has a channel twice"),
        ("OFFSET 10 0 0", "OFFSET 1e300 0 0", "3 finite numbers were expected"),
        ("HIERARCHY\nROOT Hips\n{", "HIERARCHY\nROOT Hips\n{\n{", "is cut off"),
        (CASE, "", "has no joints"),
        (CASE, "\x00\xff binary", "has no joints"),
    ],
)
def test_damaged_files_are_refused(chain, old, new, problem):
    assert old in CASE
    chain.write_text(CASE.replace(old, new, 1))
    with pytest.raises(UserError, match=problem):
        read_bvh(chain, 0)


def test_a_brace_before_the_first_joint_is_ignored(chain):
    chain.write_text(CASE.replace("ROOT", "{\n}\nROOT", 1))
    np.testing.assert_allclose(read_bvh(chain, 0)["left hip"], [11, 90, 2], atol=1e-9)


def test_a_frame_beyond_the_end_is_refused(chain):
    with pytest.raises(UserError, match="has 2 frames, numbered from 0; there is no 2"):
        read_bvh(chain, 2)


def test_the_needed_joints_are_joints():
    assert {name for joints in EXPECTED.values() for name in joints[1]} <= set(JOINTS)
