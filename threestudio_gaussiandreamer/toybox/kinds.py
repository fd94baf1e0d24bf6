"""The kinds of the toybox: each a function from random proportions to shapes; and the accessories.

z is up and the front is +x.

Roles: "body" and "part" take the prompt's colours; "dark", "pale", "warm" and "glass" are fixed
details, which tell the front from the back. Sizes are arbitrary, since ``world.py`` scales every
object to the same bounding sphere."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from .shapes import Shape, box, cone, ellipsoid, lathe, limb, ring


class Anchors(NamedTuple):
    """Where accessories go."""

    top: tuple[float, float, float]
    """Where a hat sits and a pole stands."""
    top_radius: float
    neck: tuple[float, float, float]
    """Centre of a scarf."""
    neck_radii: tuple[float, float]
    """Half axes of the scarf's ring."""
    neck_axis: tuple[float, float, float] = (0.0, 0.0, 1.0)
    cape: tuple[Shape, ...] = ()
    """What a person wears as "cape"."""


Model = tuple[list[Shape], Anchors]
"""What a kind's function returns."""
CORNERS = [(i, j) for i in (-1, 1) for j in (-1, 1)]


class Proportions:
    """Random proportions around 1: ``p(spread)`` is uniform in [1 - spread, 1 + spread]."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, spread: float = 0.12) -> float:
        return float(self._rng.uniform(1 - spread, 1 + spread))

    def chance(self, share: float) -> bool:
        """Draw true with probability ``share``."""
        return bool(self._rng.random() < share)

    def choice(self, names: Sequence[str]) -> str:
        """Draw one of these."""
        return names[int(self._rng.random() * len(names))]


def eyes(x: float, y: float, z: float, radius: float) -> list[Shape]:
    return [ellipsoid("dark", (x, s * y, z), (radius,) * 3, rings=6) for s in (-1, 1)]


def legs(x: float, y: float, top: float, radius: float, role: str = "body") -> list[Shape]:
    return [limb(role, (i * x, j * y, 0), (i * x, j * y, top), radius) for i, j in CORNERS]


def wheels(x: float, y: float, radius: float) -> list[Shape]:
    """Make four wheels with pale hubs."""
    wheels = []
    for i, j in CORNERS:
        inner, outer = (np.array([i * x, j * (y + w), radius]) for w in (-0.08, 0.08))
        wheels += [limb("dark", inner, outer, radius)]
        wheels += [limb("pale", outer, outer + [0, j * 0.02, 0], 0.5 * radius)]
    return wheels


def fox(p: Proportions) -> Model:
    length, head = 0.62 * p(), 0.3 * p()
    x, z = length + 0.1, 0.98 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.6), (length, 0.28 * p(), 0.28 * p())),
        *legs(0.62 * length, 0.15, 0.55, 0.08),
        ellipsoid("body", (x, 0, z), (head, head, 0.9 * head)),
        limb("body", (0.7 * length, 0, 0.7), (x, 0, z), 0.19),
        cone("pale", (x + 0.6 * head, 0, z - 0.07), (x + 2.0 * head, 0, z - 0.12), 0.6 * head),
        ellipsoid("dark", (x + 1.95 * head, 0, z - 0.11), (0.06, 0.06, 0.06), rings=6),
        *eyes(x + 0.82 * head, 0.14, z + 0.1, 0.055),
        ellipsoid("part", (-length - 0.28, 0, 0.74), (0.17, 0.17, 0.4), axis=(-0.9, 0, 0.55)),
    ]
    for s in (-1, 1):
        foot = (x - 0.02, s * 0.17, z + 0.6 * head)
        shapes += [cone("part", foot, (x - 0.05, s * 0.26, z + 1.75 * head), 0.14)]
    tip = (-length - 0.55 * p(), 0, 0.95 * p())
    shapes += [ellipsoid("pale", tip, (0.12, 0.12, 0.17), axis=(-0.9, 0, 0.55))]
    hat, neck = (x - 0.03, 0, z + 0.78 * head), (0.84 * length, 0, 0.76)
    return shapes, Anchors(hat, 0.2, neck, (0.24, 0.24), (0.75, 0, 0.65))


def rabbit(p: Proportions) -> Model:
    fat, head = 0.4 * p(), 0.31 * p()
    z = 1.02 * p(0.06)
    shapes = [
        ellipsoid("body", (-0.05, 0, 0.45), (fat * 1.1, fat, 0.46)),
        ellipsoid("body", (0.16, 0, z), (head, 0.9 * head, 0.95 * head)),
    ]
    ears = 0.62 * p(0.2)
    for s in (-1, 1):
        ear = (0.06, s * 0.15, z + 0.75 * head + 0.5 * ears)
        shapes += [
            ellipsoid("part", ear, (0.07, 0.11, 0.55 * ears), axis=(-0.12, s * 0.2, 1)),
            ellipsoid("body", (0.32, s * 0.24, 0.12), (0.3, 0.13, 0.12)),
            limb("body", (0.2, s * 0.2, 0.6), (0.42, s * 0.17, 0.32), 0.09),
        ]
    shapes += [
        ellipsoid("pale", (-fat - 0.14, 0, 0.34), (0.16, 0.16, 0.16)),
        *eyes(0.16 + 0.88 * head, 0.13, z + 0.08, 0.055),
        ellipsoid("warm", (0.16 + head, 0, z - 0.04), (0.06, 0.07, 0.05), rings=6),
    ]
    hat, neck = (0.1, 0, z + 0.85 * head), (0.07, 0, z - 0.82 * head)
    return shapes, Anchors(hat, 0.2, neck, (0.29, 0.28), (0.15, 0, 1))


def bear(p: Proportions) -> Model:
    fat, head = 0.46 * p(), 0.36 * p()
    z = 1.2 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.6), (0.9 * fat, fat, 0.52)),
        ellipsoid("body", (0.05, 0, z), (0.92 * head, head, 0.9 * head)),
        ellipsoid("part", (0.5 * fat, 0, 0.58), (0.5 * fat, 0.68 * fat, 0.36)),
    ]
    for s in (-1, 1):
        arm = (0.14, s * (fat + 0.08), 0.72)
        shapes += [
            ellipsoid("body", (0, s * 0.78 * head, z + 0.75 * head), (0.09, 0.15, 0.15)),
            ellipsoid("body", arm, (0.14, 0.14, 0.32), axis=(0.35, s * -0.35, 1)),
            limb("body", (0.05, s * 0.25, 0.3), (0.4, s * 0.32, 0.13), 0.18, 0.17),
            ellipsoid("pale", (0.44, s * 0.33, 0.13), (0.06, 0.14, 0.14)),
        ]
    shapes += [
        ellipsoid("pale", (0.05 + 0.85 * head, 0, z - 0.08), (0.15, 0.17, 0.13)),
        *eyes(0.05 + 0.86 * head, 0.15, z + 0.1, 0.05),
        ellipsoid("dark", (0.18 + 0.85 * head, 0, z - 0.03), (0.06, 0.07, 0.05), rings=6),
    ]
    hat, neck = (0.03, 0, z + 0.82 * head), (0.03, 0, z - 0.8 * head)
    return shapes, Anchors(hat, 0.24, neck, (0.32, 0.33))


def duck(p: Proportions) -> Model:
    length, head = 0.6 * p(), 0.27 * p()
    z = 0.98 * p(0.08)
    shapes = [
        ellipsoid("body", (0, 0, 0.42), (length, 0.42 * p(), 0.36)),
        ellipsoid("body", (0.42, 0, z), (head, head, head)),
        limb("body", (0.36, 0, 0.5), (0.41, 0, z), 0.22, 0.17),
        cone("body", (-0.7 * length, 0, 0.5), (-1.35 * length, 0, 0.82), 0.2),
    ]
    for s in (-1, 1):
        shapes += [
            ellipsoid("part", (-0.06, s * 0.38, 0.5), (0.38, 0.09, 0.22), axis=(-0.2, 0, 1)),
            ellipsoid("warm", (0.1, s * 0.2, 0.04), (0.2, 0.12, 0.04)),
            limb("warm", (0.03, s * 0.2, 0.05), (0.03, s * 0.2, 0.25), 0.04),
        ]
    shapes += [
        ellipsoid("warm", (0.42 + 1.2 * head, 0, z - 0.05), (0.24, 0.15, 0.06)),
        *eyes(0.42 + 0.78 * head, 0.16, z + 0.09, 0.05),
    ]
    hat, neck = (0.4, 0, z + 0.85 * head), (0.39, 0, z - 0.95 * head)
    return shapes, Anchors(hat, 0.19, neck, (0.22, 0.22), (0.1, 0, 1))


def elephant(p: Proportions) -> Model:
    fat, head = 0.5 * p(), 0.36 * p()
    x, z = 0.72 * p(0.06), 1.02 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.78), (0.66, fat, 0.48)),
        *legs(0.36, 0.26, 0.6, 0.16),
        ellipsoid("body", (x, 0, z), (head, head, head)),
    ]
    bend = (x + 0.46, 0, 0.52 * p())
    shapes += [
        limb("body", (x + 0.2, 0, z - 0.08), bend, 0.17, 0.11),
        limb("body", bend, (x + 0.68, 0, 0.3), 0.11, 0.08),
    ]
    for s in (-1, 1):
        ear, tusk = (x - 0.1, s * (head + 0.16), z + 0.06), (x + 0.25, s * 0.16, z - 0.18)
        shapes += [
            ellipsoid("part", ear, (0.06, 0.3 * p(), 0.34), axis=(0.25, 0, 1)),
            limb("pale", tusk, (x + 0.56, s * 0.2, z - 0.24), 0.05, 0.03),
        ]
    shapes += [
        *eyes(x + 0.84 * head, 0.2, z + 0.1, 0.05),
        limb("dark", (-0.64, 0, 0.86), (-0.82, 0, 0.45), 0.035),
    ]
    hat = (x - 0.05, 0, z + 0.85 * head)
    return shapes, Anchors(hat, 0.24, (0.45, 0, 0.86), (0.42, 0.4), (1, 0, 0.35))


def penguin(p: Proportions) -> Model:
    fat, head = 0.42 * p(), 0.3 * p()
    z = 1.18 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.6), (0.88 * fat, fat, 0.58)),
        ellipsoid("body", (0.02, 0, z), (head, head, head)),
        ellipsoid("part", (0.42 * fat, 0, 0.56), (0.56 * fat, 0.74 * fat, 0.46)),
    ]
    for s in (-1, 1):
        wing = (-0.02, s * (fat + 0.07), 0.62)
        shapes += [
            ellipsoid("body", wing, (0.15, 0.06, 0.4 * p()), axis=(0, s * -0.4, 1)),
            ellipsoid("warm", (0.2, s * 0.18, 0.05), (0.24, 0.14, 0.06)),
        ]
    shapes += [
        cone("warm", (0.9 * head, 0, z - 0.02), (0.9 * head + 0.3 * p(), 0, z - 0.07), 0.1),
        *eyes(0.85 * head, 0.14, z + 0.1, 0.05),
    ]
    hat, neck = (0, 0, z + 0.85 * head), (0.02, 0, z - 0.85 * head)
    return shapes, Anchors(hat, 0.21, neck, (0.27, 0.28))


def turtle(p: Proportions) -> Model:
    length = 0.66 * p()
    wide = 0.55 * p()
    bend = np.linspace(0, np.pi / 2, 7)
    profile = [(0.0, 0.16), *zip(np.cos(bend) * 1.0, 0.16 + 0.5 * p() * np.sin(bend), strict=True)]
    shell = lathe("body", profile)
    stretched, uv = shell.vertices * [length, wide, 1.0], shell.uv * (length + wide) / 2
    x = length + 0.26
    feet = [(i * 0.5, j * (wide + 0.06), 0.1) for i, j in CORNERS]
    shapes = [
        shell._replace(vertices=stretched, uv=uv),
        ring("part", (0, 0, 0.18), (length * 0.96, wide * 0.96), 0.09, height=0.08),
        ellipsoid("part", (x, 0, 0.46), (0.29, 0.23, 0.22)),
        limb("part", (0.7 * length, 0, 0.2), (x, 0, 0.42), 0.14),
        *(ellipsoid("part", foot, (0.22, 0.17, 0.1)) for foot in feet),
        cone("part", (-0.9 * length, 0, 0.16), (-length - 0.28, 0, 0.1), 0.1),
        *eyes(x + 0.2, 0.15, 0.55, 0.055),
    ]
    hat, neck = (0, 0, profile[-1][1]), (0.82 * length + 0.1, 0, 0.3)
    return shapes, Anchors(hat, 0.24, neck, (0.2, 0.2), (1, 0, 0.5))


def car(p: Proportions) -> Model:
    long, high = 0.86 * p(), 0.2 * p()
    base = 0.26
    cabin = 0.46 * p(0.15)
    top = base + 2 * high
    shapes = [
        box("body", (0, 0, base + high), (long, 0.42, high), (0.97, 0.92)),
        *wheels(0.58 * long, 0.42, 0.23),
        box("glass", (-0.1, 0, top + 0.15), (cabin, 0.36, 0.15), (0.72, 0.85)),
        box("part", (-0.1, 0, top + 0.32), (0.78 * cabin, 0.33, 0.04)),
    ]
    lamps = [(long, s * 0.28, base + 1.1 * high) for s in (-1, 1)]
    shapes += [ellipsoid("pale", lamp, (0.05, 0.09, 0.09), rings=6) for lamp in lamps]
    shapes += [box("warm", (-x, y, z), (0.03, 0.08, 0.06)) for x, y, z in lamps]
    shapes += [box("dark", (long, 0, base + 0.35 * high), (0.05, 0.3, 0.05))]
    hat, neck = (-0.1, 0, top + 0.36), (0.45 * long, 0, base + high)
    return shapes, Anchors(hat, 0.26, neck, (0.46, 1.15 * high), (1, 0, 0))


def truck(p: Proportions) -> Model:
    load, high = 0.66 * p(), 0.42 * p()
    x = load + 0.05
    shapes = [
        box("dark", (0.05, 0, 0.27), (load + 0.36, 0.3, 0.06)),
        *wheels(0.66 * (load + 0.3), 0.4, 0.23),
        box("part", (-0.32, 0, 0.34 + high), (load, 0.44, high)),
        box("body", (x, 0, 0.64), (0.3, 0.42, 0.32), (0.9, 0.95)),
        box("glass", (x + 0.27, 0, 0.78), (0.05, 0.36, 0.13)),
    ]
    shapes += [box("glass", (x + 0.04, s * 0.41, 0.78), (0.16, 0.03, 0.12)) for s in (-1, 1)]
    lamps = [(x + 0.3, s * 0.28, 0.46) for s in (-1, 1)]
    shapes += [ellipsoid("pale", lamp, (0.05, 0.08, 0.08), rings=6) for lamp in lamps]
    shapes += [box("body", (-0.32, 0, 0.34 + 2 * high + 0.02), (0.9 * load, 0.38, 0.03))]
    hat, neck = (x - 0.08, 0, 0.96), (-0.32 + 0.5 * load, 0, 0.34 + high)
    return shapes, Anchors(hat, 0.24, neck, (1.12 * high, 0.5), (1, 0, 0))


def boat(p: Proportions) -> Model:
    long, mast = 0.8 * p(), 1.3 * p(0.1)
    shapes = [
        box("body", (0, 0, 0.2), (0.72 * long, 0.26, 0.2), (1.25, 1.35)),
        cone("body", (0.6 * long, 0, 0.24), (1.35 * long, 0, 0.36), 0.24),
        limb("dark", (0.05, 0, 0.3), (0.05, 0, mast), 0.045),
    ]
    sail = box("part", (-0.3, 0, 0.5 + 0.38 * mast), (0.36 * p(), 0.03, 0.36 * mast), (0.08, 1.0))
    sheared = sail.vertices + np.outer(sail.vertices[:, 2] - 0.5, [0.28, 0, 0])
    shapes += [
        sail._replace(vertices=sheared),
        box("warm", (0, 0, 0.41), (0.7 * long, 0.28, 0.02)),
        box("pale", (-0.5 * long, 0, 0.5), (0.16, 0.18, 0.1)),
    ]
    hat, neck = (0.05, 0, mast - 0.02), (0.4 * long, 0, 0.24)
    return shapes, Anchors(hat, 0.2, neck, (0.26, 0.34), (1, 0, 0))


def plane(p: Proportions) -> Model:
    long, span = 0.8 * p(), 0.85 * p()
    shapes = [
        ellipsoid("body", (0, 0, 0.5), (long, 0.26 * p(), 0.27)),
        ellipsoid("glass", (0.42 * long, 0, 0.71), (0.22, 0.14, 0.12)),
        box("part", (0.1, 0, 0.46), (0.2 * p(), span, 0.035)),
        box("part", (-0.85 * long, 0, 0.56), (0.1, 0.34, 0.03)),
        box("part", (-0.86 * long, 0, 0.76), (0.13, 0.03, 0.24), (0.55, 1)),
        cone("warm", (0.92 * long, 0, 0.5), (long + 0.12, 0, 0.5), 0.1),
        box("dark", (long + 0.06, 0, 0.5), (0.02, 0.05, 0.27)),
    ]
    for s in (-1, 1):
        shapes += [
            limb("dark", (0.2, s * 0.2, 0.4), (0.2, s * 0.25, 0.18), 0.03),
            limb("dark", (0.2, s * 0.2, 0.12), (0.2, s * 0.3, 0.12), 0.11),
        ]
    neck = (-0.42 * long, 0, 0.5)
    return shapes, Anchors((0.02, 0, 0.75), 0.2, neck, (0.25, 0.25), (1, 0, 0))


def house(p: Proportions) -> Model:
    deep, wide, high = 0.5 * p(), 0.6 * p(), 0.36 * p()
    roof, top = 0.28 * p(0.2), 2 * high
    shapes = [
        box("body", (0, 0, high), (deep, wide, high)),
        box("part", (0, 0, top + roof), (deep + 0.12, wide + 0.1, roof), (0.04, 0.94)),
        box("pale", (deep, 0, 0.27), (0.025, 0.2, 0.27)),
        box("dark", (deep, 0, 0.23), (0.035, 0.14, 0.23)),
        box("warm", (-0.2, 0.3, top + 1.4 * roof), (0.1, 0.1, 0.8 * roof + 0.12)),
    ]
    z = high * 1.15
    shapes += [box("glass", (deep, s * 0.62 * wide, z), (0.025, 0.13, 0.13)) for s in (-1, 1)]
    shapes += [box("glass", (0, s * wide, z), (0.15, 0.025, 0.13)) for s in (-1, 1)]
    hat, neck = (0, 0, top + 2 * roof - 0.04), (0, 0, 0.62 * top)
    return shapes, Anchors(hat, 0.22, neck, (deep * 1.22, wide * 1.2))


def mug(p: Proportions) -> Model:
    radius, high = 0.44 * p(), 0.95 * p()
    outside = [(0, 0), (radius, 0), (radius * p(0.08), high)]
    handle = (radius + 0.02, 0, 0.52 * high)
    shapes = [
        lathe("body", [*outside, (0.86 * radius, high), (0.84 * radius, 0.12)]),
        lathe("pale", [(0.84 * radius, 0.1), (0, 0.1)]),
        lathe("dark", [(0.85 * radius, 0.78 * high), (0, 0.78 * high)]),
        ring("part", handle, (0.22 * p(), 0.27 * p()), 0.07, axis=(0, -1, 0)),
    ]
    hat, neck = (-0.9 * radius, 0, high), (0, 0, 0.5 * high)
    return shapes, Anchors(hat, 0.15, neck, (radius * 1.02, radius * 1.02))


def chair(p: Proportions) -> Model:
    half, seat, back = 0.42 * p(), 0.55 * p(), 0.62 * p()
    x, y = -half + 0.05, half - 0.06
    shapes = [
        box("body", (0, 0, seat), (half, half, 0.06)),
        *legs(half - 0.07, half - 0.07, seat, 0.055),
        box("body", (x, 0, seat + back), (0.05, half, 0.5 * back)),
    ]
    shapes += [limb("body", (x, s * y, seat), (x, s * y, seat + back), 0.05) for s in (-1, 1)]
    shapes += [ellipsoid("part", (0.05, 0, seat + 0.1), (0.82 * half, 0.85 * half, 0.09))]
    if p.chance(0.4):
        sides = [s * (half - 0.04) for s in (-1, 1)]
        shapes += [box("body", (0, y, seat + 0.32), (half, 0.05, 0.04)) for y in sides]
        x = half - 0.05
        shapes += [limb("body", (x, y, seat), (x, y, seat + 0.3), 0.04) for y in sides]
    hat, neck = (-half + 0.05, 0, seat + 1.5 * back), (-half + 0.05, 0, seat + 1.05 * back)
    return shapes, Anchors(hat, 0.18, neck, (0.12, half * 1.08))


def mushroom(p: Proportions) -> Model:
    stem, cap, high = 0.21 * p(), 0.66 * p(), 0.42 * p()
    base = 0.6 * p()
    bend = np.linspace(0, np.pi / 2, 7)
    profile = [(0, base), *zip(cap * np.cos(bend), base + high * np.sin(bend), strict=True)]
    shapes = [
        lathe("body", profile),
        lathe("part", [(0, 0), (stem * 1.35, 0), (stem, 0.3), (stem, base + 0.02)]),
        lathe("pale", [(0.97 * cap, base - 0.015), (0, base - 0.015)]),
        ring("pale", (0, 0, 0.72 * base), (stem, stem), 0.06),
    ]
    hat, neck = (0, 0, base + high - 0.01), (0, 0, 0.42 * base)
    return shapes, Anchors(hat, 0.22, neck, (stem * 1.3, stem * 1.3))


def robot(p: Proportions) -> Model:
    wide, head = 0.44 * p(), 0.25 * p()
    z = 1.3 + head
    shapes = [
        box("body", (0, 0, 0.84), (0.3, wide, 0.42)),
        box("part", (0, 0, z), (0.9 * head, 1.1 * head, head)),
        limb("dark", (0, 0, 1.2), (0, 0, z), 0.1),
        limb("dark", (0, 0, z + head), (0, 0, z + head + 0.2), 0.03),
        ellipsoid("warm", (0, 0, z + head + 0.22), (0.07, 0.07, 0.07), rings=6),
        box("pale", (0.3, 0, 0.98), (0.02, 0.5 * wide, 0.13)),
        box("dark", (0.9 * head, 0, z - 0.1), (0.02, 0.13, 0.03)),
        *eyes(0.9 * head, 0.12, z + 0.07, 0.065),
    ]
    for s in (-1, 1):
        shapes += [
            limb("part", (0, s * (wide + 0.1), 1.12), (0.1, s * (wide + 0.14), 0.55), 0.08),
            box("dark", (0.04, s * 0.19, 0.06), (0.2, 0.13, 0.06)),
            limb("part", (0, s * 0.19, 0.1), (0, s * 0.19, 0.5), 0.09),
            ellipsoid("dark", (0.11, s * (wide + 0.14), 0.49), (0.1, 0.1, 0.1)),
        ]
    return shapes, Anchors((0, 0, z + 0.97 * head), 0.2, (0, 0, 1.28), (0.17, 0.17))


ANIMALS = fox, rabbit, bear, duck, elephant, penguin, turtle
THINGS = car, truck, boat, plane, house, mug, chair, mushroom, robot
KINDS: dict[str, Callable[[Proportions], Model]] = {f.__name__: f for f in (*ANIMALS, *THINGS)}
ALIKE_FROM_ALL_SIDES = ("mug", "mushroom")
"""Kinds whose front and back don't differ."""


def _hat(anchors: Anchors, p: Proportions) -> list[Shape]:
    r = anchors.top_radius
    high = min(0.36, 1.8 * r) * p(0.2)
    brim = [(0, -0.02), (1.45 * r, -0.02), (1.45 * r, 0.05), (0, 0.05)]
    round_crown = [(0.85 * r, 0.05), (0.8 * r, high), (0, high)]
    crown = round_crown if p.chance(0.5) else [(0.95 * r, 0.05), (0, 1.35 * high)]
    return [lathe("accessory", profile, anchors.top) for profile in (brim, crown)]


def _scarf(anchors: Anchors, p: Proportions) -> list[Shape]:
    neck, radii, axis = anchors.neck, anchors.neck_radii, anchors.neck_axis
    shapes = [ring("accessory", neck, radii, 0.085, axis, height=0.11 * p())]
    turn = np.array(axis) / np.linalg.norm(axis)
    if turn[2] > 0.3:  # the ends hang in front
        front = np.array(neck) + np.array([radii[0] * turn[2], 0, -radii[0] * turn[0]])
        ends = [front + [0.05, s * 0.1, -0.17] for s in (-1, 1)]
        shapes += [box("accessory", end, (0.045, 0.075, 0.2 * p())) for end in ends]
    return shapes


def _flag(anchors: Anchors, p: Proportions) -> list[Shape]:
    x, y, z = anchors.top
    high = 0.5 * p()
    top = z + high - 0.17
    return [
        limb("dark", (x, y, z - 0.08), (x, y, z + high), 0.03),
        # two crossed sheets, so that it is seen from everywhere
        box("accessory", (x - 0.25, y, top), (0.24, 0.03, 0.16)),
        box("accessory", (x, y + 0.25, top), (0.03, 0.24, 0.16)),
    ]


def _balloon(anchors: Anchors, p: Proportions) -> list[Shape]:
    x, y, z = anchors.top
    r, high = 0.24 * p(), 0.3 * p()
    string = limb("dark", (x, y, z - 0.08), (x, y, z + high), 0.02)
    return [string, ellipsoid("accessory", (x, y, z + high + r), (r, r, 1.15 * r))]


ACCESSORIES: dict[str, Callable[[Anchors, Proportions], list[Shape]]] = {
    "hat": _hat,
    "scarf": _scarf,
    "flag": _flag,
    "balloon": _balloon,
    "cape": lambda anchors, p: list(anchors.cape),
}
"""Each returns shapes, at its place on an object, of the role "accessory"."""
