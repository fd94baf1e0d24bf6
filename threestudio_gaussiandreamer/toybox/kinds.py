"""The kinds of the toybox: each a function from random proportions to shapes.

z is up and the front is +x.

Roles: "body" and "part" take the prompt's colours; "dark", "pale", "warm" and "glass" are fixed
details, which tell the front from the back. Sizes are arbitrary, since ``world.py`` scales every
object to the same bounding sphere.
"""

from collections.abc import Callable

import numpy as np

from .animals import bear, duck, elephant, fox, penguin, rabbit, turtle
from .parts import Anchors, Model, Proportions
from .shapes import Shape, box, ellipsoid, lathe, limb, ring
from .things import boat, car, chair, house, mug, mushroom, plane, robot, truck

KINDS: dict[str, Callable[[Proportions], Model]] = {
    make.__name__: make
    for make in (
        fox,
        rabbit,
        bear,
        duck,
        elephant,
        penguin,
        turtle,
        car,
        truck,
        boat,
        plane,
        house,
        mug,
        chair,
        mushroom,
        robot,
    )
}

ORIENTED = tuple(name for name in KINDS if name not in ("mug", "mushroom"))
"""Kinds whose front and back differ."""


def accessory(name: str, anchors: Anchors, p: Proportions) -> list[Shape]:
    """Return the shapes of an accessory at its place, with the role "accessory"."""
    return ACCESSORIES[name](anchors, p)


def _hat(anchors: Anchors, p: Proportions) -> list[Shape]:
    x, y, z = anchors.top
    r, high = anchors.top_radius, 0.36 * p(0.2)
    brim = lathe(
        "accessory", [(0, -0.02), (1.45 * r, -0.02), (1.45 * r, 0.05), (0, 0.05)], (x, y, z)
    )
    crown = (
        [(0.85 * r, 0.05), (0.8 * r, high), (0, high)]
        if p.chance(0.5)
        else [(0.95 * r, 0.05), (0, 1.35 * high)]
    )
    return [brim, lathe("accessory", crown, (x, y, z))]


def _scarf(anchors: Anchors, p: Proportions) -> list[Shape]:
    shapes = [
        ring(
            "accessory",
            anchors.neck,
            anchors.neck_radii,
            0.085,
            anchors.neck_axis,
            height=0.11 * p(),
        )
    ]
    x, y, z = anchors.neck
    turn = np.array(anchors.neck_axis) / np.linalg.norm(anchors.neck_axis)
    front = np.array([x, y, z]) + (
        np.array([anchors.neck_radii[0] * turn[2], 0, -anchors.neck_radii[0] * turn[0]])
        if turn[2] > 0.3
        else 0
    )
    if turn[2] > 0.3:
        shapes += [
            box("accessory", front + [0.05, s * 0.1, -0.17], (0.045, 0.075, 0.2 * p()))
            for s in (-1, 1)
        ]
    return shapes


def _flag(anchors: Anchors, p: Proportions) -> list[Shape]:
    x, y, z = anchors.top
    high = 0.5 * p()
    pole = limb("dark", (x, y, z - 0.08), (x, y, z + high), 0.03)
    # two crossed sheets, so that it is seen from everywhere
    sheets = [
        box(
            "accessory",
            (x + 0.25 * a, y + 0.25 * b, z + high - 0.17),
            (0.24 if a else 0.03, 0.24 if b else 0.03, 0.16),
        )
        for a, b in ((-1, 0), (0, 1))
    ]
    return [pole, *sheets]


def _balloon(anchors: Anchors, p: Proportions) -> list[Shape]:
    x, y, z = anchors.top
    r = 0.24 * p()
    high = 0.3 * p()
    string = limb("dark", (x, y, z - 0.08), (x, y, z + high), 0.02)
    return [string, ellipsoid("accessory", (x, y, z + high + r), (r, r, 1.15 * r))]


ACCESSORIES: dict[str, Callable[[Anchors, Proportions], list[Shape]]] = {
    "hat": _hat,
    "scarf": _scarf,
    "flag": _flag,
    "balloon": _balloon,
}
