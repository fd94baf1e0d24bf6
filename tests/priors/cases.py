"""Helpers of the prior tests."""

from importlib.util import find_spec

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from threestudio_gaussiandreamer.host import find
from threestudio_gaussiandreamer.priors.body_pose import BODY_JOINTS, INDEX, LIMBS, PARENTS
from threestudio_gaussiandreamer.priors.motion import posed_joints

OPTIONS = {
    "mesh-prior": {"path": "box.ply"},
    "body-prior": {"path": "body.obj", "num_points": 2000},
    "point-cloud-prior": {"path": "points.ply"},
    "gaussians-prior": {"path": "gaussians.ply"},
    "random-prior": {"num_points": 500},
}
"""Needed options of each registered prior; a new prior is one row here."""
UNIFORM = np.sqrt(1 / 12)
"""Standard deviation of numbers that are uniform in [0, 1]."""


def rng(seed=0):
    return np.random.default_rng(seed)


def seeded(seed=0):
    return torch.Generator().manual_seed(seed)


def build(name, assets, **options):
    options = {**OPTIONS.get(name, {}), **options}
    if "path" in options:
        options["path"] = str(assets / options["path"])
    return find(name)(options)


# Motions ------------------------------------------------------------------------------------------


def joints_of(body, pose, shape=None, translation=None):
    shape = torch.zeros(len(pose), 10, dtype=torch.float64) if shape is None else shape
    zeros = torch.zeros(len(pose), 3, dtype=torch.float64)
    return posed_joints(body, pose, shape, zeros if translation is None else translation).numpy()


def walk(body, frames=6):
    """Return a motion (F, 22, 3): standing, then raising the left knee while turning to the
    left.
    """
    pose = torch.zeros(frames, 24, 3, dtype=torch.float64)
    pose[:, 1, 0] = torch.linspace(0, -1.2, frames)
    pose[:, 4, 0] = torch.linspace(0, 1.0, frames)
    pose[:, 0, 1] = torch.linspace(0, np.pi / 2, frames)
    return joints_of(body, pose)[:, :22]


# Poses --------------------------------------------------------------------------------------------

needs_anny = pytest.mark.skipif(find_spec("anny") is None, reason="anny isn't installed")
MIXAMO = (
    "Hips LeftUpLeg RightUpLeg Spine LeftLeg RightLeg Spine1 LeftFoot RightFoot Spine2 LeftToeBase "
    "RightToeBase Neck LeftShoulder RightShoulder Head LeftArm RightArm LeftForeArm RightForeArm "
    "LeftHand RightHand"
).split()
"""Names of the joints of ``body_pose.JOINTS`` in Mixamo's files."""


def random_local(seed: int, degrees: float = 40) -> np.ndarray:
    """Return random rotations of all joints relative to their parents, (22, 3, 3)."""
    angles = rng(seed).normal(scale=np.radians(degrees), size=(BODY_JOINTS, 3))
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
    bones = [np.array([at[end] - at[start] for start, end in ends]) for at in (found, wanted)]
    cosines = np.einsum("lc,lc->l", *(b / np.linalg.norm(b, axis=1, keepdims=True) for b in bones))
    return np.degrees(np.arccos(cosines.clip(-1, 1)))


def bvh_text(heads: np.ndarray, frames: list[np.ndarray], names: list[str] = MIXAMO) -> str:
    """Return a BVH of a skeleton, with one frame for each set of local rotations."""
    lines, order = ["HIERARCHY"], []

    def write(joint: int) -> None:
        order.append(joint)
        offset = heads[joint] - heads[PARENTS[joint]] if joint else np.zeros(3)
        position = "6 Xposition Yposition Zposition" if not joint else "3"
        lines.extend([f"{'JOINT' if joint else 'ROOT'} {names[joint]}", "{"])
        lines.append("OFFSET " + " ".join(f"{100 * value:.9f}" for value in offset))
        lines.append(f"CHANNELS {position} Xrotation Yrotation Zrotation")
        children = [child for child in range(BODY_JOINTS) if PARENTS[child] == joint]
        for child in children:
            write(child)
        lines.extend([] if children else ["End Site", "{", "OFFSET 0 1 0", "}"])
        lines.append("}")

    write(0)
    lines += ["MOTION", f"Frames: {len(frames)}", "Frame Time: 0.033333"]
    for local in frames:
        angles = [Rotation.from_matrix(local[joint]).as_euler("XYZ", True) for joint in order]
        lines.append(" ".join(f"{value:.9f}" for value in [0, 90, 0, *np.concatenate(angles)]))
    return "\n".join(lines)
