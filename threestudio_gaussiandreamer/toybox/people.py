"""The toybox's person: clothes, hair and face around the joints of a pose, in the kinds' axes.

Roles beside those of ``kinds.py``: "body" is the shirt, "part" the trousers; "skin", "tan" and
"hair" are fixed details. Hair and a cape are at the back; face, buckle and buttons in front."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from ..priors.body_pose import INDEX, SIDES, Z_UP, unit
from .kinds import Anchors, Model, Proportions
from .shapes import Shape, box, ellipsoid, limb


class Trunk(NamedTuple):
    """Axes of the chest: forwards, to the left, and upwards."""

    ahead: Float[np.ndarray, "3"]
    left: Float[np.ndarray, "3"]
    up: Float[np.ndarray, "3"]


def person(p: Proportions, joints: Float[np.ndarray, "22 3"]) -> Model:
    """Dress a pose (y up, looking along +z)."""
    at = {name: joints[index][Z_UP] for name, index in INDEX.items()}
    up = unit(at["neck"] - at["lower spine"])
    left = at["left shoulder"] - at["right shoulder"]
    left = unit(left - up * (left @ up))
    trunk = Trunk(np.cross(left, up), left, up)
    chest = (at["middle spine"] + 2 * at["upper spine"] + at["neck"]) / 4
    skin = "skin" if p.chance(0.6) else "tan"
    shapes = [*upper_body(at, chest, trunk, p), *lower_body(at, trunk, p)]
    sleeves = 1.0 if p.chance(0.6) else 0.35
    for side in SIDES:
        shapes += arm(at, side, sleeves, skin, p)
    head, top = head_shapes(at, trunk, skin, p)
    neck, cape = tuple(at["neck"] + 0.02 * trunk.up), (cape_shape(chest, trunk, p),)
    return [*shapes, *head], Anchors(tuple(top), 0.14, neck, (0.1, 0.1), cape=cape)


def upper_body(at: dict, chest: np.ndarray, trunk: Trunk, p: Proportions) -> list[Shape]:
    """Make the shirt without its sleeves, and buttons."""
    wide, deep = 0.21 * p(0.08), 0.15 * p()
    waist = (at["pelvis"] + at["lower spine"]) / 2
    long = np.linalg.norm(at["neck"] - waist)
    shapes = [
        oriented("body", chest, (deep, wide, 0.5 * long), trunk),
        oriented("body", (chest + waist) / 2, (0.95 * deep, 0.85 * wide, 0.45 * long), trunk),
    ]
    middle = chest + 0.92 * deep * trunk.ahead
    return shapes + [
        ellipsoid("pale", middle + step * trunk.up, (0.03,) * 3, rings=6)
        for step in (-0.1, 0.0, 0.1)
    ]


def lower_body(at: dict, trunk: Trunk, p: Proportions) -> list[Shape]:
    """Make trousers, belt and shoes."""
    thigh = 0.108 * p(0.1)
    hips = (at["left hip"] + at["right hip"]) / 2
    belt = (at["pelvis"] + at["lower spine"]) / 2
    shapes = [
        oriented("part", (hips + at["pelvis"]) / 2, (0.14, 0.19, 0.13), trunk),
        oriented("dark", belt, (0.15, 0.195, 0.035), trunk),
        ellipsoid("warm", belt + 0.145 * trunk.ahead, (0.03, 0.04, 0.035), rings=6),
    ]
    for side in SIDES:
        hip, knee, ankle, toe = (at[f"{side} {n}"] for n in ("hip", "knee", "ankle", "foot"))
        shapes += [
            limb("part", hip, knee, thigh, 0.8 * thigh),
            ellipsoid("part", knee, (0.8 * thigh,) * 3, rings=8),
            limb("part", knee, ankle, 0.8 * thigh, 0.075),
            limb("dark", ankle + (ankle - toe) * 0.3, toe + (toe - ankle) * 0.3, 0.075, 0.062),
        ]
    return shapes


def arm(at: dict, side: str, sleeve: float, skin: str, p: Proportions) -> list[Shape]:
    """Make an arm with a sleeve over this share of its lower part, and a hand."""
    shoulder, elbow, wrist = (at[f"{side} {n}"] for n in ("shoulder", "elbow", "wrist"))
    thick = 0.078 * p(0.1)
    end = elbow + sleeve * 0.92 * (wrist - elbow)
    return [
        ellipsoid("body", shoulder, (1.15 * thick,) * 3, rings=8),
        limb("body", shoulder, elbow, thick, 0.88 * thick),
        ellipsoid("body", elbow, (0.88 * thick,) * 3, rings=8),
        limb("body", elbow, end, 0.88 * thick, 0.8 * thick),
        limb(skin, elbow, wrist, 0.062, 0.05),
        ellipsoid(skin, wrist + 0.2 * (wrist - elbow), (0.08,) * 3, rings=8),
    ]


def head_shapes(
    at: dict, trunk: Trunk, skin: str, p: Proportions
) -> tuple[list[Shape], np.ndarray]:
    """Make neck, head, face and hair; return them and the place of a hat."""
    up = at["head"] - at["neck"]
    up = 0.5 * trunk.up + 0.5 * up / np.linalg.norm(up)
    r = 0.16 * p(0.08)
    center = at["head"] + 0.09 * up
    hair = p.choice(("hair", "dark", "warm", "pale"))
    shapes = [
        limb(skin, at["neck"] - 0.03 * trunk.up, center, 0.065),
        oriented(skin, center, (r, 0.9 * r, 1.12 * r), trunk),
        oriented(hair, center - 0.3 * r * trunk.ahead + 0.22 * r * up, (r, r, 1.1 * r), trunk),
        ellipsoid(skin, center + 1.02 * r * trunk.ahead - 0.1 * r * up, (0.033,) * 3, rings=6),
    ]
    if p.chance(0.4):  # long hair
        low = center - 0.55 * r * trunk.ahead - 0.9 * r * up
        shapes += [oriented(hair, low, (0.45 * r, 0.8 * r, 1.2 * r), trunk)]
    for sign in (-1, 1):
        eye = center + 0.9 * r * trunk.ahead + sign * 0.4 * r * trunk.left + 0.12 * r * up
        shapes += [ellipsoid("dark", eye, (0.03,) * 3, rings=6)]
    return shapes, center + 1.05 * r * up - 0.1 * r * trunk.ahead


def cape_shape(chest: np.ndarray, trunk: Trunk, p: Proportions) -> Shape:
    """Make a cape that hangs from the shoulders to the knees."""
    top = chest + 0.16 * trunk.up - 0.165 * trunk.ahead
    up = -unit(-0.65 * trunk.up + np.array([0.0, 0.0, -0.35]) - 0.12 * trunk.ahead)
    long = 0.36 * p(0.1)
    half = (0.025, 0.3 * p(0.08), long)
    ahead = unit(np.cross(trunk.left, up))
    axes = np.stack([ahead, np.cross(up, ahead), up])
    return turned(box("accessory", (0, 0, 0), half, (1.0, 0.68)), axes, top - long * up)


def oriented(role: str, center, radii, trunk: Trunk) -> Shape:
    """Make an ellipsoid with half axes along the trunk's axes."""
    return turned(ellipsoid(role, (0, 0, 0), radii), np.stack(trunk), center)


def turned(shape: Shape, axes: Float[np.ndarray, "3 3"], center) -> Shape:
    return shape._replace(vertices=shape.vertices @ axes + center, normals=shape.normals @ axes)
