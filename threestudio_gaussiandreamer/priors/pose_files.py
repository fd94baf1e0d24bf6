"""Read poses of SMPL's joints from files: axis-angle rotations (NPZ, NPY), or BVH.

* NPZ with ``poses`` (F, 3 J), as AMASS has them, or with ``global_orient`` (F, 3) and ``body_pose``
  (F, 63 or 69), as smplx's arguments; the frames' dimension may be missing;
* NPY with (3 J,), (F, 3 J), (J, 3) or (F, J, 3);
* BVH, whose joints are found by their names.

J is 22, 24, 52 or 55 joints in the order of SMPL, SMPL-H or SMPL-X, of which the first 22 are used.
y is up, but in files with AMASS's frame rate, where z is.

Programs name joints in a BVH differently ("LeftUpLeg", "lThigh", "mixamorig:LeftUpLeg", "thigh.L",
"L_Hip"). The names are split into a side and a part; the tables list the parts of each joint. Any
further joints, as fingers, are ignored, and neither the file's unit nor its rest pose matter, since
the body takes only directions from the positions."""

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError, unknown
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from .body_pose import BODY_JOINTS, NEEDED, SIDES, Body, pose_of_positions, pose_of_rotations

TO_BODY = {
    "y": np.eye(3),
    "z": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]]),
    "-y": np.diag([1.0, -1.0, -1.0]),
}
"""Rotation about x from a file's axes to the body's, by the file's axis that is up."""
BODY_UP = "y"
AMASS_UP = "z"
FRAME_RATES = ("mocap_framerate", "mocap_frame_rate")
"""Arrays that AMASS's files have."""
JOINT_COUNTS = (22, 24, 52, 55)
SUFFIXES = (".bvh", ".npz", ".npy")
CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
SIDE_WORDS = {"left": "left", "l": "left", "right": "right", "r": "right"}
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
"""Parts of the names of each joint, the most specific one first: "foot" is the ankle in files
without an "ankle", and "shoulder" the upper arm in those without an "arm"."""
LARGEST = 1e9
"""Largest number that is plausible, in any unit; squares of larger ones could overflow."""


def read_pose(
    path: str, body: Body, *, frame: int = 0, up: str = "auto"
) -> Float[np.ndarray, "22 3 3"]:
    """Return one frame of a pose file as a pose of the body.

    Args:
        up: the file's axis that is up: "y", "z", "-y", or "auto".

    Raises:
        UserError: the file is missing, of another format, damaged, not finite, or has no such
            frame.
    """
    with reading(path, "pose file") as file:
        suffix = file.suffix.lower()
        if suffix not in SUFFIXES:
            raise unknown(f"format of the pose file {path!r}:", suffix, SUFFIXES)
        if suffix == ".bvh":
            pose, stated = pose_of_positions(body, read_bvh(file, frame)), BODY_UP
        else:
            local, stated = read_axis_angles(file, frame)
            pose = pose_of_rotations(body, local)
        require(np.isfinite(pose).all(), f"it has rotations in frame {frame} that are too large")
    return TO_BODY[stated if up == "auto" else up] @ pose


def read_axis_angles(path: Path, frame: int) -> tuple[Float[np.ndarray, "22 3 3"], str]:
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
    up = AMASS_UP if any(name in arrays for name in FRAME_RATES) else BODY_UP
    return Rotation.from_rotvec(chosen).as_matrix(), up


def require_frame(frame: int, count: int, name: str) -> None:
    """Raise UserError unless a file or motion has this frame."""
    if frame >= count:
        raise UserError(f"frame: {name} has {count} frames, numbered from 0; there is no {frame}")


def _angles(arrays: dict[str, np.ndarray]) -> Optional[Float[np.ndarray, "F J3"]]:
    """Return the rotations in any of the layouts as (frames, 3 x joints); None if they have none of
    them.
    """
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


@dataclass
class Joint:
    """A joint of the hierarchy."""

    name: str
    parent: Optional[int]
    offset: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path, frame: int) -> dict[str, Float[np.ndarray, "3"]]:
    """Return the positions of the known joints in one frame of a BVH, in the file's unit and axes.

    Raises:
        Unreadable: it is damaged, or lacks joints that a pose needs.
        UserError: it has no such frame.
    """
    hierarchy, _, motion = path.read_text(encoding="utf-8", errors="replace").partition("MOTION")
    joints = _hierarchy(hierarchy)
    names = joint_names([joint.name for joint in joints])
    rows = [line for line in motion.splitlines() if line.strip()]
    rows = [line for line in rows if not line.lstrip().startswith("Frame")]
    require_frame(frame, len(rows), f"BVH file {str(path)!r}")
    values = _numbers(rows[frame].split(), sum(len(joint.channels) for joint in joints))
    positions = _positions(joints, values)
    return {name: positions[number] for name, number in names.items()}


def joint_names(names: list[str]) -> dict[str, int]:
    """Return the index of the file's joint for each joint of ``body_pose.py`` that it has.

    Raises:
        Unreadable: a joint of ``NEEDED`` is missing.
    """
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

    >>> split_name("mixamorig:LeftUpLeg"), split_name("thigh.L"), split_name("lShldr")
    (('left', 'upleg'), ('left', 'thigh'), ('left', 'shldr'))
    """
    words = [str(word).lower() for word in WORDS.findall(PREFIX.sub("", name))]
    side = next((SIDE_WORDS[word] for word in words if word in SIDE_WORDS), "")
    if side:
        words.remove(next(word for word in words if word in SIDE_WORDS))
    elif words and (glued := re.match(r"(left|right)(.+)", words[0])):
        side, words[0] = glued.groups()
    return side, re.sub(r"(?<=[a-z])0+(?=\d)", "", "".join(words))


def _hierarchy(text: str) -> list[Joint]:
    """Return the joints in the order of their channels; parents come first."""
    joints: list[Joint] = []
    above: list[Optional[int]] = []
    current: Optional[int] = None
    for line in text.splitlines():
        kind, *words = line.split() or [""]
        if kind in ("ROOT", "JOINT", "End"):
            ends = kind == "End"  # an end site has no channels and no name of its own
            joints.append(Joint("" if ends else " ".join(words), current))
        elif kind == "{":
            above.append(current)
            current = len(joints) - 1 if joints else None
        elif kind == "}" and above:
            current = above.pop()
        elif kind == "OFFSET" and joints:
            joints[-1].offset = _numbers(words, 3)
        elif kind == "CHANNELS" and joints:
            joints[-1].channels = words[1:]
            expected = f"expected different ones of {', '.join(CHANNELS)}"
            fits = len(set(words[1:]) & set(CHANNELS)) == len(words[1:])
            require(fits, f"it has channels {' '.join(words[1:])}; {expected}")
    require(bool(joints), "its hierarchy has no joints")
    require(not above, "its hierarchy is cut off")
    return joints


def _numbers(words: list[str], count: int) -> Float[np.ndarray, " N"]:
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.array([np.nan])
    fits = len(values) == count and (np.abs(values) < LARGEST).all()
    line = " ".join(words)[:80]
    require(fits, f"{count} finite numbers were expected in the line {line!r}")
    return values


def _positions(joints: list[Joint], values: Float[np.ndarray, " C"]) -> Float[np.ndarray, "J 3"]:
    """Return the positions of all joints; a joint's position channels replace its offset."""
    from scipy.spatial.transform import Rotation

    positions, turns, used = np.zeros((len(joints), 3)), [], 0
    for number, joint in enumerate(joints):
        channels = dict(zip(joint.channels, values[used:], strict=False))
        used += len(joint.channels)
        offset = [channels.get(name, o) for name, o in zip(CHANNELS[:3], joint.offset, strict=True)]
        rotations = [name for name in joint.channels if name.endswith("rotation")]
        turn = Rotation.identity()
        if rotations:
            axes = "".join(name[0] for name in rotations)
            turn = Rotation.from_euler(axes, [channels[name] for name in rotations], degrees=True)
        if joint.parent is not None:
            above = turns[joint.parent]
            offset = positions[joint.parent] + above.apply(offset)
            turn = above * turn
        positions[number] = offset
        turns.append(turn)
    return positions
