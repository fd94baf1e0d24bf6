"""Helpers of the tests of poses."""

from importlib.util import find_spec

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from threestudio_gaussiandreamer.priors.body_pose import INDEX, LIMBS
from threestudio_gaussiandreamer.priors.skeleton import BODY_JOINTS, PARENTS

needs_anny = pytest.mark.skipif(find_spec("anny") is None, reason="anny isn't installed")
MIXAMO = (
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase "
    "RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm "
    "LeftHand RightHand"
).split()
"""Names of the joints of ``skeleton.JOINTS`` in Mixamo's files."""


def random_local(seed: int, degrees: float = 40) -> np.ndarray:
    """Return random rotations of all joints relative to their parents, (22, 3, 3)."""
    angles = np.random.default_rng(seed).normal(scale=np.radians(degrees), size=(BODY_JOINTS, 3))
    return Rotation.from_rotvec(angles).as_matrix()


def walked(heads: np.ndarray, local: np.ndarray) -> np.ndarray:
    """Return the positions of joints rotated about their parents' axes, by plain recursion."""
    turns, positions = [local[0]], [heads[0]]
    for joint in range(1, BODY_JOINTS):
        parent = PARENTS[joint]
        positions.append(positions[parent] + turns[parent] @ (heads[joint] - heads[parent]))
        turns.append(turns[parent] @ local[joint])
    return np.array(positions)


def limb_angles(found: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Return the angles, degrees, between the limbs of two skeletons of any size."""
    ends = [(INDEX[name], INDEX[end]) for name, end in LIMBS.items()]
    bones = [
        np.array([joints[end] - joints[start] for start, end in ends]) for joints in (found, wanted)
    ]
    cosines = np.einsum("lc,lc->l", *(b / np.linalg.norm(b, axis=1, keepdims=True) for b in bones))
    return np.degrees(np.arccos(cosines.clip(-1, 1)))


def bvh_text(heads: np.ndarray, frames: list[np.ndarray], names: list[str] = MIXAMO) -> str:
    """Return a BVH of a skeleton, with one frame for each set of local rotations."""
    lines, order = ["HIERARCHY"], []

    def write(joint: int) -> None:
        order.append(joint)
        offset = heads[joint] - heads[PARENTS[joint]] if joint else np.zeros(3)
        position = "6 Xposition Yposition Zposition" if not joint else "3"
        lines.extend(
            [
                f"{'JOINT' if joint else 'ROOT'} {names[joint]}",
                "{",
                "OFFSET " + " ".join(f"{100 * value:.9f}" for value in offset),
                f"CHANNELS {position} Xrotation Yrotation Zrotation",
            ]
        )
        children = [child for child in range(BODY_JOINTS) if PARENTS[child] == joint]
        for child in children:
            write(child)
        if not children:
            lines.extend(["End Site", "{", "OFFSET 0 1 0", "}"])
        lines.append("}")

    write(0)
    lines += ["MOTION", f"Frames: {len(frames)}", "Frame Time: 0.033333"]
    for local in frames:
        angles = [Rotation.from_matrix(local[joint]).as_euler("XYZ", True) for joint in order]
        lines.append(" ".join(f"{value:.9f}" for value in [0, 90, 0, *np.concatenate(angles)]))
    return "\n".join(lines)
