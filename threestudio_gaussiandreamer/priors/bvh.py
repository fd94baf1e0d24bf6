"""Read joint positions of one frame of a BVH file, with the joints named as in ``skeleton.py``.

Programs name joints differently ("LeftUpLeg", "lThigh", "mixamorig:LeftUpLeg", "thigh.L", "L_Hip").
The names are split into a side and a part; the tables list the parts of each joint. Any further
joints, as fingers, are ignored, and neither the file's unit nor its rest pose matter, since the
body takes only directions from the positions."""

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Optional

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError, unknown
from .body_pose import NEEDED

CHANNELS = ("Xposition", "Yposition", "Zposition", "Xrotation", "Yrotation", "Zrotation")
SIDES = {"left": "left", "l": "left", "right": "right", "r": "right"}
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


@dataclass
class Joint:
    """A joint of the hierarchy."""

    name: str
    parent: Optional[int]
    offset: Float[np.ndarray, "3"] = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)


def read_bvh(path: Path, frame: int) -> dict[str, Float[np.ndarray, "3"]]:
    """Return the positions of the known joints in one frame, in the file's unit and axes.

    Raises:
        UserError: the file is damaged, has no such frame, numbers that aren't finite, or lacks
            joints that a pose needs.
    """
    hierarchy, _, motion = path.read_text(encoding="utf-8", errors="replace").partition("MOTION")
    joints = list(_hierarchy(hierarchy, path))
    names = joint_names([joint.name for joint in joints], path)
    values = _frame_values(motion, sum(len(joint.channels) for joint in joints), frame, path)
    positions = _positions(joints, values)
    return {name: positions[number] for name, number in names.items()}


# ---- names ---------------------------------------------------------------------------------------


def joint_names(names: list[str], path: Path) -> dict[str, int]:
    """Return the index of the file's joint for each joint of ``skeleton.py`` that it has.

    Raises:
        UserError: a joint of ``NEEDED`` is missing.
    """
    known = {}
    for number, name in enumerate(names):
        known.setdefault(split_name(name), number)
    found: dict[str, int] = {}
    wanted = [(name, ("", parts)) for name, parts in CENTRAL.items()] + [
        (f"{side} {name}", (side, parts))
        for side in ("left", "right")
        for name, parts in PAIRED.items()
    ]
    for name, (side, parts) in wanted:
        number = next((known[side, part] for part in parts if (side, part) in known), None)
        if number is not None and number not in found.values():
            found[name] = number
    if missing := [name for name in NEEDED if name not in found]:
        raise UserError(
            f"BVH file {str(path)!r} has no joint that is known as the {', the '.join(missing)}: "
            f"its joints are {', '.join(filter(None, names[:40]))}. Rename them, for example to "
            "LeftUpLeg, LeftLeg, LeftArm, LeftForeArm"
        )
    return found


def split_name(name: str) -> tuple[str, str]:
    """Split a joint's name into its side ("left", "right" or "") and its part in lower case.

    >>> split_name("mixamorig:LeftUpLeg"), split_name("thigh.L"), split_name("lShldr")
    (('left', 'upleg'), ('left', 'thigh'), ('left', 'shldr'))
    """
    words = [str(word).lower() for word in WORDS.findall(PREFIX.sub("", name))]
    side = next((SIDES[word] for word in words if word in SIDES), "")
    if side:
        words.remove(next(word for word in words if word in SIDES))
    elif words and (glued := re.match(r"(left|right)(.+)", words[0])):
        side, words[0] = glued.groups()
    return side, re.sub(r"(?<=[a-z])0+(?=\d)", "", "".join(words))


# ---- content -------------------------------------------------------------------------------------


def _hierarchy(text: str, path: Path) -> Iterator[Joint]:
    """Yield the joints in the order of their channels; parents come first."""
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
            joints[-1].offset = _numbers(words, 3, path)
        elif kind == "CHANNELS" and joints:
            joints[-1].channels = _channels(words[1:], path)
    if not joints or above:
        raise UserError(
            f"BVH file {str(path)!r} is damaged: its hierarchy "
            f"{'has no joints' if not joints else 'is cut off'}"
        )
    yield from joints


def _channels(words: list[str], path: Path) -> list[str]:
    """Check the names of a joint's channels, each of which may occur once."""
    for word in words:
        if word not in CHANNELS:
            raise unknown(f"channel in the BVH file {str(path)!r}", word, CHANNELS)
    if len(set(words)) < len(words):
        raise UserError(f"BVH file {str(path)!r} is damaged: a joint has a channel twice")
    return words


def _frame_values(text: str, count: int, frame: int, path: Path) -> Float[np.ndarray, " C"]:
    """Return the values of all channels in one frame."""
    lines = [line for line in text.splitlines() if line.strip()]
    rows = [line for line in lines if not line.lstrip().startswith("Frame")]
    if frame >= len(rows):
        raise UserError(
            f"frame: BVH file {str(path)!r} has {len(rows)} frames, numbered from 0; there is no "
            f"{frame}"
        )
    return _numbers(rows[frame].split(), count, path)


def _numbers(words: list[str], count: int, path: Path) -> Float[np.ndarray, " N"]:
    try:
        values = np.array(words, np.float64)
    except ValueError:
        values = np.array([np.nan])
    if len(values) != count or not (np.abs(values) < LARGEST).all():
        raise UserError(
            f"BVH file {str(path)!r} is damaged: {count} finite numbers were expected in the line "
            f"{' '.join(words)[:80]!r}"
        )
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
