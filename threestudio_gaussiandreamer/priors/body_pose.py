"""Bodies, whose joints are those of SMPL: their axes, and their poses by rotations of the joints
relative to a T-pose, or so that their limbs point as those of given joint positions.

Bodies have y up and look along +z, the left side at +x, as SMPL, HumanML3D and MakeHuman have them.
A pose is the rotation of every joint's part of the body from the rest pose, (22, 3, 3), in the
body's axes. Skinning is linear (linear blend skinning)."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError
from ..meshes.mesh import Mesh

JOINTS = (
    "pelvis, left hip, right hip, lower spine, left knee, right knee, middle spine, left "
    "ankle, right ankle, upper spine, left foot,"
    " right foot, neck, left collar, right collar, head, left shoulder, right shoulder, left "
    "elbow, right elbow, left wrist, right wrist,"
    " left hand, right hand"
).split(", ")
BODY_JOINTS = 22
"""The first joints of SMPL, SMPL-H and SMPL-X, and all of HumanML3D."""
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
"""Of the first ``BODY_JOINTS`` joints; every joint comes after its parent."""
LEFT, RIGHT = (1, 16), (2, 17)
"""Hip and shoulder of each side."""
SIDES = ("left", "right")
INDEX = {name: number for number, name in enumerate(JOINTS[:BODY_JOINTS])}
CHAINS = ("hip", "knee", "ankle", "foot"), ("shoulder", "elbow", "wrist")
LIMBS = {"neck": "head"} | {
    f"{side} {joint}": f"{side} {end}"
    for side in SIDES
    for chain in CHAINS
    for joint, end in zip(chain, chain[1:], strict=False)
}
"""The end of the bone that begins at a joint, for bones that positions give a direction."""
SPINE = {"lower spine": 1 / 3, "middle spine": 2 / 3, "upper spine": 1.0}
"""How far each joint of the spine turns from the pelvis' orientation to the chest's."""
NEEDED = [f"{side} {joint}" for side in SIDES for joint in ("hip", "knee", "shoulder", "elbow")]
"""Joints without whose positions there is no pose."""
LEAST_EXTENT = 1e-6
"""Smallest width and height of hips and chest, relative to their sum."""
Degrees = tuple[float, float, float]

POSES: dict[str, dict[str, Degrees]] = {
    "A": {"left shoulder": (0, 0, -45), "right shoulder": (0, 0, 45)},
    "T": {},
    "walking": {
        "left hip": (-28, 0, 0), "left knee": (6, 0, 0),
        "right hip": (16, 0, 0), "right knee": (28, 0, 0), "right ankle": (18, 0, 0),
        "left shoulder": (24, 0, -72), "left elbow": (0, -18, 0),
        "right shoulder": (-24, 0, 72), "right elbow": (0, 24, 0),
    },
    "sitting": {
        "left hip": (-88, 0, 0), "left knee": (86, 0, 0),
        "right hip": (-88, 0, 0), "right knee": (86, 0, 0),
        "left shoulder": (-24, 0, -70), "left elbow": (0, -40, 0),
        "right shoulder": (-24, 0, 70), "right elbow": (0, 40, 0),
    },
}  # fmt: skip
"""Rotations of joints from a T-pose, degrees: about z first, then y, then x, the parent's axes."""


class Body(NamedTuple):
    """A body at rest: y up, looking along +z, arms lowered by 45 degrees; metres."""

    vertices: Float[np.ndarray, "V 3"]
    faces: Int[np.ndarray, "F 3"]
    uv: Float[np.ndarray, "T 2"]
    """v upwards."""
    face_uv: Int[np.ndarray, "F 3"]
    """Rows of ``uv`` at the corners of each face."""
    joints: Float[np.ndarray, "22 3"]
    weights: Float[np.ndarray, "V 22"]
    """By how much each vertex moves with each joint; rows sum to 1."""


def posed(body: Body, pose: Float[np.ndarray, "22 3 3"]) -> Body:
    """Return the body in a pose, with its pelvis where it is at rest."""
    joints = body.joints.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            offset = body.joints[joint] - body.joints[parent]
            joints[joint] = joints[parent] + pose[parent] @ offset
    moved = np.einsum("vj,jab,vb->va", body.weights, pose, body.vertices, optimize=True)
    shifts = joints - np.einsum("jab,jb->ja", pose, body.joints)
    return body._replace(vertices=moved + body.weights @ shifts, joints=joints)


def named_pose(body: Body, name: str) -> Float[np.ndarray, "22 3 3"]:
    """Return a pose of ``POSES``."""
    from scipy.spatial.transform import Rotation

    local = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))
    for joint, angles in POSES[name].items():
        local[INDEX[joint]] = Rotation.from_euler("zyx", angles[::-1], degrees=True).as_matrix()
    return pose_of_rotations(body, local)


def pose_of_rotations(
    body: Body, local: Float[np.ndarray, "22 3 3"]
) -> Float[np.ndarray, "22 3 3"]:
    """Return the pose in which the joints are rotated as SMPL's.

    Args:
        local: rotation of each joint relative to its parent, from a T-pose; the first one that of
            the whole body.
    """
    turned = local.copy()
    for joint, parent in enumerate(PARENTS):
        if parent >= 0:
            turned[joint] = turned[parent] @ local[joint]
    # in a T-pose the arms point sideways, and hands move with the lower arms
    to_t_pose = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        shoulder, elbow, wrist = (INDEX[f"{side} {joint}"] for joint in CHAINS[1])
        for joint, end in ((shoulder, elbow), (elbow, wrist)):
            bone = body.joints[end] - body.joints[joint]
            to_t_pose[joint] = swing(bone, np.array([sign, 0.0, 0.0]))
        to_t_pose[wrist] = to_t_pose[elbow]
    return turned @ to_t_pose


def pose_of_positions(
    body: Body, positions: dict[str, Float[np.ndarray, "3"]]
) -> Float[np.ndarray, "22 3 3"]:
    """Return the pose in which hips, chest and limbs point as those of a skeleton of any size.

    Args:
        positions: of joints, by their names in ``JOINTS``; those in ``NEEDED`` must be there, and
            "pelvis", "lower spine", "neck", "head" and the ends of the limbs may be.
    """
    from scipy.spatial.transform import Rotation, Slerp

    rest = {name: body.joints[number] for name, number in INDEX.items()}
    known = {name: rest[name] for name in rest if name in positions}
    frames = [[part_frame(p, part) for p in (positions, known)] for part in ("hip", "shoulder")]
    pelvis, chest = (found @ resting.T for found, resting in frames)
    between = Slerp([0, 1], Rotation.from_matrix(np.stack([pelvis, chest])))
    pose = np.tile(pelvis, (BODY_JOINTS, 1, 1))
    for joint, parent in list(enumerate(PARENTS))[1:]:
        name = JOINTS[joint]
        pose[joint] = between(SPINE[name]).as_matrix() if name in SPINE else pose[parent]
        end = LIMBS.get(name)
        if name in positions and end in positions:
            bone = pose[joint] @ (rest[end] - rest[name])
            pose[joint] = swing(bone, positions[end] - positions[name]) @ pose[joint]
    return pose


def part_frame(positions: dict[str, Float[np.ndarray, "3"]], part: str) -> Float[np.ndarray, "3 3"]:
    """Return the orientation of the hips ("hip") or of the chest ("shoulder"): its columns are the
    directions to the left, up and to the front.

    Raises:
        UserError: the joints are on one line, so that they have no orientation.
    """
    left, right = positions[f"left {part}"], positions[f"right {part}"]
    low, chest = (
        (positions[f"left {name}"] + positions[f"right {name}"]) / 2 for name in ("hip", "shoulder")
    )
    high = positions.get("neck", chest)
    if part == "hip":
        high = positions.get("lower spine", high)
    across = _unit(left - right)
    rise = (high - low) - ((high - low) @ across) * across
    size = np.linalg.norm(high - low) + np.linalg.norm(left - right)
    if min(np.linalg.norm(left - right), np.linalg.norm(rise)) <= LEAST_EXTENT * size:
        raise UserError(
            f"the pose has its {part}s and spine on one line: there is no front; choose another "
            "frame or file"
        )
    up = _unit(rise)
    return np.stack([across, up, np.cross(across, up)], axis=1)


def swing(
    source: Float[np.ndarray, "3"], target: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation of the direction of ``source`` to that of ``target``; the
    identity where one of them has no length.
    """
    from scipy.spatial.transform import Rotation

    if not (np.linalg.norm(source) > 1e-9 and np.linalg.norm(target) > 1e-9):
        return np.eye(3)
    a, b = _unit(source), _unit(target)
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    if np.linalg.norm(axis) < 1e-9:  # parallel, or opposite: any perpendicular axis
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
    return Rotation.from_rotvec(angle * _unit(axis)).as_matrix()


def _unit(vector: Float[np.ndarray, "3"]) -> Float[np.ndarray, "3"]:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def z_up(points: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Rotate points from y up, front +z, to z up, front +x."""
    return points[:, [2, 0, 1]]


def facing(joints: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about the world's z axis after which a body with these joints (y up)
    faces +x.

    The front is horizontal and perpendicular to the sum of the vectors from the left to the right
    hip and shoulder. If that sum is vertical or zero, the body isn't rotated."""
    joints = z_up(joints)
    across = (joints[list(RIGHT)] - joints[list(LEFT)]).sum(axis=0)
    forward = np.cross([0.0, 0.0, 1.0], across)[:2]
    length = np.linalg.norm(forward)
    if length < 1e-6:
        return np.eye(3)
    x, y = forward / length
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def world_mesh(mesh: Mesh, joints: Float[np.ndarray, "K 3"], scale: float) -> Mesh:
    """Return a body with z up that faces +x, its box centred, and ``scale`` as half the longest
    side.

    Args:
        mesh: y up, any unit.
        joints: the body's, in the mesh's axes.
    """
    vertices = z_up(mesh.vertices) @ facing(joints).T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return mesh._replace(vertices=scale * (vertices - (low + high) / 2) / ((high - low).max() / 2))
