"""Bodies whose joints are those of SMPL, their poses, and files of poses.

Bodies have y up and look along +z, the left side at +x, as SMPL, HumanML3D and MakeHuman have them.
A pose is the rotation of every joint's part of the body from the rest pose, (22, 3, 3), in the
body's axes. Skinning is linear. Poses are read from

* NPZ with ``poses`` (F, 3 J), as AMASS has them, or with ``global_orient`` (F, 3) and ``body_pose``
  (F, 63 or 69), as smplx's arguments; the frames' dimension may be missing;
* NPY with (3 J,), (F, 3 J), (J, 3) or (F, J, 3), axis-angle rotations as those of NPZ;
* BVH, whose joints are found by their names.

J is 22, 24, 52 or 55 joints in the order of SMPL, SMPL-H or SMPL-X, of which the first 22 are used.
y is up, but in files with AMASS's frame rate, where z is.

Programs name joints in a BVH differently ("LeftUpLeg", "lThigh", "thigh.L", "L_Hip"); names are
split into a side and a part. Further joints, as fingers, are ignored, and neither the file's unit
nor its rest pose matter, since the body takes only directions from the positions."""

import re
from pathlib import Path
from typing import NamedTuple, Optional

import numpy as np
from jaxtyping import Float, Int

from ..core.errors import UserError, unknown
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from ..meshes.mesh import Mesh

JOINTS = (
    "pelvis, left hip, right hip, lower spine, left knee, right knee, middle spine, left ankle, "
    "right ankle, upper spine, left foot, right foot, neck, left collar, right collar, head, left "
    "shoulder, right shoulder, left elbow, right elbow, left wrist, right wrist, left hand, right "
    "hand"
).split(", ")
BODY_JOINTS = 22
"""The first joints of SMPL, SMPL-H and SMPL-X, and all of HumanML3D."""
PARENTS = (-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19)
"""Of the first ``BODY_JOINTS`` joints; every joint comes after its parent."""
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
Pose = Float[np.ndarray, "22 3 3"]
Point = Float[np.ndarray, "3"]
Z_UP = [2, 0, 1]
"""The axes of z up, front +x, among those of y up, front +z."""
POSES: dict[str, dict[str, tuple[float, float, float]]] = {
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
    joints: Float[np.ndarray, "22 3"]
    weights: Float[np.ndarray, "V 22"]
    """By how much each vertex moves with each joint; rows sum to 1."""


def posed(body: Body, pose: Pose) -> Body:
    """Return the body in a pose, with its pelvis where it is at rest."""
    joints = body.joints.copy()
    for joint, parent in enumerate(PARENTS[1:], 1):
        offset = body.joints[joint] - body.joints[parent]
        joints[joint] = joints[parent] + pose[parent] @ offset
    moved = np.einsum("vj,jab,vb->va", body.weights, pose, body.vertices, optimize=True)
    shifts = joints - np.einsum("jab,jb->ja", pose, body.joints)
    return body._replace(vertices=moved + body.weights @ shifts, joints=joints)


def named_pose(body: Body, name: str) -> Pose:
    """Return a pose of ``POSES``."""
    from scipy.spatial.transform import Rotation

    local = np.tile(np.eye(3), (BODY_JOINTS, 1, 1))
    for joint, angles in POSES[name].items():
        local[INDEX[joint]] = Rotation.from_euler("zyx", angles[::-1], degrees=True).as_matrix()
    return pose_of_rotations(body, local)


def pose_of_rotations(body: Body, local: Pose) -> Pose:
    """Return the pose in which each joint is rotated relative to its parent, from a T-pose, as
    SMPL's; the first rotation is that of the whole body.
    """
    turned = local.copy()
    for joint, parent in enumerate(PARENTS[1:], 1):
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


def pose_of_positions(body: Body, positions: dict[str, Point]) -> Pose:
    """Return the pose in which hips, chest and limbs point as those of a skeleton of any size, of
    which at least the positions of the joints in ``NEEDED`` are known.
    """
    from scipy.spatial.transform import Rotation, Slerp

    rest = {name: body.joints[number] for name, number in INDEX.items()}
    known = {name: rest[name] for name in rest if name in positions}
    frames = [[part_frame(p, part) for p in (positions, known)] for part in ("hip", "shoulder")]
    pelvis, chest = (found @ resting.T for found, resting in frames)
    between = Slerp([0, 1], Rotation.from_matrix(np.stack([pelvis, chest])))
    pose = np.tile(pelvis, (BODY_JOINTS, 1, 1))
    for joint, parent in enumerate(PARENTS[1:], 1):
        name = JOINTS[joint]
        pose[joint] = between(SPINE[name]).as_matrix() if name in SPINE else pose[parent]
        end = LIMBS.get(name)
        if name in positions and end in positions:
            bone = pose[joint] @ (rest[end] - rest[name])
            pose[joint] = swing(bone, positions[end] - positions[name]) @ pose[joint]
    return pose


def part_frame(positions: dict[str, Point], part: str) -> Float[np.ndarray, "3 3"]:
    """Return the columns left, up and front of the hips ("hip") or of the chest ("shoulder")."""
    left, right = positions[f"left {part}"], positions[f"right {part}"]
    low, chest = (
        (positions[f"left {name}"] + positions[f"right {name}"]) / 2 for name in ("hip", "shoulder")
    )
    high = positions.get("neck", chest)
    if part == "hip":
        high = positions.get("lower spine", high)
    across, width = unit(left - right), np.linalg.norm(left - right)
    rise = (high - low) - ((high - low) @ across) * across
    size = np.linalg.norm(high - low) + width
    if min(width, np.linalg.norm(rise)) <= 1e-6 * size:
        raise UserError(
            f"the pose has its {part}s and spine on one line: there is no front; choose another "
            "frame or file"
        )
    up = unit(rise)
    return np.stack([across, up, np.cross(across, up)], axis=1)


def swing(source: Point, target: Point) -> Float[np.ndarray, "3 3"]:
    """Return the smallest rotation from ``source`` to ``target``; the identity if one is zero."""
    from scipy.spatial.transform import Rotation

    if not (np.linalg.norm(source) > 1e-9 and np.linalg.norm(target) > 1e-9):
        return np.eye(3)
    a, b = unit(source), unit(target)
    axis = np.cross(a, b)
    angle = np.arctan2(np.linalg.norm(axis), a @ b)
    if np.linalg.norm(axis) < 1e-9:  # parallel, or opposite: any perpendicular axis
        axis = np.cross(a, np.eye(3)[np.abs(a).argmin()])
    return Rotation.from_rotvec(angle * unit(axis)).as_matrix()


def unit(vector: Point) -> Point:
    return vector / max(float(np.linalg.norm(vector)), 1e-12)


def facing(joints: Float[np.ndarray, "K 3"]) -> Float[np.ndarray, "3 3"]:
    """Return the rotation about the world's z axis after which a body with these joints (y up)
    faces +x, perpendicular to the sum of the vectors from the left to the right hip and shoulder;
    the identity if that sum is vertical or zero.
    """
    joints = joints[:, Z_UP]
    across = (joints[[2, 17]] - joints[[1, 16]]).sum(axis=0)  # hips and shoulders
    forward = np.cross([0.0, 0.0, 1.0], across)[:2]
    length = np.linalg.norm(forward)
    if length < 1e-6:
        return np.eye(3)
    x, y = forward / length
    return np.array([[x, y, 0.0], [-y, x, 0.0], [0.0, 0.0, 1.0]])


def world_mesh(mesh: Mesh, joints: Float[np.ndarray, "K 3"], scale: float) -> Mesh:
    """Return a body with z up that faces +x, its box centred, and ``scale`` as half the longest
    side; given are mesh and joints with y up, in any unit.
    """
    vertices = mesh.vertices[:, Z_UP] @ facing(joints).T
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    return mesh._replace(vertices=scale * (vertices - (low + high) / 2) / ((high - low).max() / 2))


# Files of poses -----------------------------------------------------------------------------------

TO_BODY = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
}
"""Rotation about x from a file's axes to the body's, by the file's axis that is up."""
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate")
"""Arrays that AMASS's files have."""
JOINT_COUNTS = (22, 24, 52, 55)
SUFFIXES = (".bvh", ".npz", ".npy")
CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
PREFIX = re.compile(r"^.*:|^mixamorig\d*_?|^bip\d*[ _]", re.IGNORECASE)
WORDS = re.compile(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])|\d+")
CENTRAL = {
    "pelvis": ("hips", "hip", "pelvis", "root"),
    "lower spine": ("spine", "lowerback", "spine1", "abdomen", "torso"),
    "neck": ("neck", "neck1"),
    "head": ("head",),
}
PAIRED = {
    "hip": ("upleg", "upperleg", "thigh", "hip", "upperleg1"),
    "knee": ("leg", "lowerleg", "lowleg", "shin", "calf", "knee", "lowerleg1"),
    "ankle": ("ankle", "foot"),
    "foot": ("toebase", "toe", "toes", "ball", "toe0", "foot"),
    "shoulder": ("arm", "upperarm", "uparm", "shldr", "shoulder", "upperarm1"),
    "elbow": ("forearm", "lowerarm", "lowarm", "elbow", "lowerarm1"),
    "wrist": ("wrist", "hand"),
}
"""Parts of the names of each joint, the most specific one first."""


def read_pose(path: str, body: Body, *, frame: int = 0, up: str = "auto") -> Pose:
    """Return one frame of a pose file, or a pose of ``POSES``, as a pose of the body.

    Args:
        up: the file's axis that is up: "y", "z", "-y", or "auto".

    Raises:
        UserError: the file is missing, damaged, of another format, or has no such frame.
    """
    if path in POSES:
        return named_pose(body, path)
    suffix = Path(path).suffix.lower()
    if suffix not in SUFFIXES:
        raise unknown("pose", path, [*POSES, *(f"a {known} file" for known in SUFFIXES)])
    with reading(path, "pose file") as file:
        if suffix == ".bvh":
            pose, stated = pose_of_positions(body, read_bvh(file, frame)), "y"
        else:
            local, stated = read_axis_angles(file, frame)
            pose = pose_of_rotations(body, local)
        require(np.isfinite(pose).all(), f"it has rotations in frame {frame} that are too large")
    return TO_BODY[stated if up == "auto" else up] @ pose


def read_axis_angles(path: Path, frame: int) -> tuple[Pose, str]:
    """Return the rotations of one frame, and the axis that is up."""
    from scipy.spatial.transform import Rotation

    required = ["poses"] if path.suffix.lower() == ".npy" else []
    names = ("poses", "global_orient", "body_pose", *FRAME_RATES)
    arrays = read_arrays(path, "pose file", required, names)
    angles = _angles(arrays)
    given = ", ".join(f"{name} {a.shape} of {a.dtype}" for name, a in arrays.items())
    require(
        angles is not None,
        f"it has {given or 'neither poses nor body_pose'}: axis-angle rotations were expected, "
        f"(frames, 3 x joints) or (frames, joints, 3) of {', '.join(map(str, JOINT_COUNTS))} "
        "joints in poses, or in global_orient and body_pose; matrices aren't read",
    )
    require_frame(frame, len(angles), f"pose file {str(path)!r}")
    chosen = np.asarray(angles[frame, : 3 * BODY_JOINTS], np.float64).reshape(-1, 3)
    finite = np.isfinite(chosen).all()
    require(finite, f"it has rotations that are NaN or infinite in frame {frame}")
    up = "z" if any(name in arrays for name in FRAME_RATES) else "y"
    return Rotation.from_rotvec(chosen).as_matrix(), up


def require_frame(frame: int, count: int, name: str) -> None:
    """Raise UserError unless a file or motion has this frame."""
    if frame >= count:
        raise UserError(f"frame: {name} has {count} frames, numbered from 0; there is no {frame}")


def _angles(arrays: dict[str, np.ndarray]) -> Optional[Float[np.ndarray, "F J3"]]:
    """Return the rotations as (frames, 3 x joints); None if they have none of the layouts."""
    found = arrays.get("poses", arrays.get("body_pose", np.zeros(0)))
    if found.dtype.kind not in "fiu" or found.shape[-2:] == (3, 3) or not found.size:
        return None
    if found.ndim == 1 or found.ndim == 2 and found.shape[1] == 3:
        found = found[None]  # one frame
    found = found.reshape(len(found), -1)
    if "poses" not in arrays:
        root = arrays.get("global_orient", np.zeros((len(found), 3)))
        root = root[None] if root.ndim == 1 else root
        root = root.reshape(len(root), -1)
        if root.shape != (len(found), 3):
            return None
        found = np.concatenate([root, found], axis=1)
    return found if found.shape[1] in [3 * count for count in JOINT_COUNTS] else None


# BVH -----------------------------------------------------------------------------------------


def read_bvh(path: Path, frame: int) -> dict[str, Point]:
    """Return the positions of the known joints in one frame of a BVH, in its unit and axes. A
    joint's position channels replace its offset.
    """
    from scipy.spatial.transform import Rotation

    hierarchy, _, motion = path.read_text(encoding="utf-8", errors="replace").partition("MOTION")
    require("ROOT" in hierarchy, "its hierarchy has no joints")
    rows = [line for line in motion.splitlines() if line.strip() and "Frame" not in line]
    require_frame(frame, len(rows), f"BVH file {str(path)!r}")
    count = sum(len(words.split()) for words in re.findall(r"CHANNELS +\d+(.*)", hierarchy))
    values = _numbers(rows[frame].split(), count)
    names, positions, turns = [], [], []
    above, current, used = [], None, 0
    for line in hierarchy.splitlines():
        kind, *words = line.split() or [""]
        if kind in ("ROOT", "JOINT", "End"):
            names.append("" if kind == "End" else " ".join(words))  # end sites have no name
            positions.append(np.zeros(3))
            turns.append(Rotation.identity())
        elif kind == "{":
            above.append(current)
            current = len(names) - 1 if names else None
        elif kind == "}" and above:
            current = above.pop()
        elif kind in ("OFFSET", "CHANNELS") and above:
            channels, turn = {}, Rotation.identity()
            if kind == "OFFSET":
                offset = _numbers(words, 3)
            else:
                channels = dict(zip(words[1:], values[used:], strict=False))
                used += len(words) - 1
                fits = len(channels) == len(words) - 1 and set(channels) <= set(CHANNELS)
                expected = f"expected different ones of {', '.join(CHANNELS)}"
                require(fits, f"it has channels {' '.join(words[1:])}; {expected}")
            place = [channels.get(name, o) for name, o in zip(CHANNELS, offset, strict=False)]
            if turns_by := {name[0]: v for name, v in channels.items() if "rotation" in name}:
                turn = Rotation.from_euler("".join(turns_by), [*turns_by.values()], degrees=True)
            if above[-1] is not None:
                place = positions[above[-1]] + turns[above[-1]].apply(place)
                turn = turns[above[-1]] * turn
            positions[current], turns[current] = np.ravel(place), turn
    require(not above, "its hierarchy is cut off")
    return {name: positions[number] for name, number in joint_names(names).items()}


def joint_names(names: list[str]) -> dict[str, int]:
    """Return the index of the file's joint for each joint that it has."""
    known = {}
    for number, name in enumerate(names):
        known.setdefault(split_name(name), number)
    found: dict[str, int] = {}
    wanted = [(name, "", parts) for name, parts in CENTRAL.items()]
    wanted += [(f"{s} {name}", s, parts) for s in SIDES for name, parts in PAIRED.items()]
    for name, side, parts in wanted:
        number = next((known[side, part] for part in parts if (side, part) in known), None)
        if number is not None and number not in found.values():
            found[name] = number
    missing = [name for name in NEEDED if name not in found]
    require(
        not missing,
        f"it has no joint that is known as the {', the '.join(missing)}: its joints are "
        f"{', '.join(filter(None, names[:40]))}. Rename them, for example to LeftUpLeg, LeftLeg, "
        "LeftArm, LeftForeArm",
    )
    return found


def split_name(name: str) -> tuple[str, str]:
    """Split a joint's name into its side ("left", "right" or "") and its part in lower case.

    >>> split_name("mixamorig:LeftUpLeg"), split_name("thigh.L")
    (('left', 'upleg'), ('left', 'thigh'))
    """
    words = [word.lower() for word in WORDS.findall(PREFIX.sub("", name))]
    found = next((word for word in words if word in ("left", "l", "right", "r")), "")
    side = {"l": "left", "r": "right"}.get(found[:1], "")
    if side:
        words.remove(found)
    elif words and (glued := re.match(r"(left|right)(.+)", words[0])):
        side, words[0] = glued.groups()
    return side, re.sub(r"(?<=[a-z])0+(?=\d)", "", "".join(words))


def _numbers(words: list[str], count: int) -> Float[np.ndarray, " N"]:
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.array([np.nan])
    # squares of larger ones could overflow
    fits = len(values) == count and (np.abs(values) < 1e9).all()
    line = " ".join(words)[:80]
    require(fits, f"{count} finite numbers were expected in the line {line!r}")
    return values
