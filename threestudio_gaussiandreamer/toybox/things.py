"""Vehicles, buildings and other things among the kinds: see ``kinds.py``."""

import numpy as np

from .parts import Anchors, Model, Proportions, eyes, legs, wheels
from .shapes import box, cone, ellipsoid, lathe, limb, ring


def car(p: Proportions) -> Model:
    long, high = 0.86 * p(), 0.2 * p()
    base = 0.26
    cabin = 0.46 * p(0.15)
    top = base + 2 * high
    shapes = [
        box("body", (0, 0, base + high), (long, 0.42, high), (0.97, 0.92)),
        *wheels(0.58 * long, 0.42, 0.23),
    ]
    shapes += [box("glass", (-0.1, 0, top + 0.15), (cabin, 0.36, 0.15), (0.72, 0.85))]
    shapes += [box("part", (-0.1, 0, top + 0.32), (0.78 * cabin, 0.33, 0.04))]
    shapes += [
        ellipsoid("pale", (long, s * 0.28, base + 1.1 * high), (0.05, 0.09, 0.09), rings=6)
        for s in (-1, 1)
    ]
    shapes += [
        box("warm", (-long, s * 0.28, base + 1.1 * high), (0.03, 0.08, 0.06)) for s in (-1, 1)
    ]
    shapes += [box("dark", (long, 0, base + 0.35 * high), (0.05, 0.3, 0.05))]
    return Model(
        shapes,
        Anchors(
            (-0.1, 0, top + 0.36),
            0.26,
            (0.45 * long, 0, base + high),
            (0.46, 1.15 * high),
            (1, 0, 0),
        ),
    )


def truck(p: Proportions) -> Model:
    load = 0.66 * p()
    high = 0.42 * p()
    shapes = [
        box("dark", (0.05, 0, 0.27), (load + 0.36, 0.3, 0.06)),
        *wheels(0.66 * (load + 0.3), 0.4, 0.23),
    ]
    shapes += [box("part", (-0.32, 0, 0.34 + high), (load, 0.44, high))]
    x = load + 0.05
    shapes += [
        box("body", (x, 0, 0.64), (0.3, 0.42, 0.32), (0.9, 0.95)),
        box("glass", (x + 0.27, 0, 0.78), (0.05, 0.36, 0.13)),
    ]
    shapes += [box("glass", (x + 0.04, s * 0.41, 0.78), (0.16, 0.03, 0.12)) for s in (-1, 1)]
    shapes += [
        ellipsoid("pale", (x + 0.3, s * 0.28, 0.46), (0.05, 0.08, 0.08), rings=6) for s in (-1, 1)
    ]
    shapes += [box("body", (-0.32, 0, 0.34 + 2 * high + 0.02), (0.9 * load, 0.38, 0.03))]
    return Model(
        shapes,
        Anchors(
            (x - 0.08, 0, 0.96),
            0.24,
            (-0.32 + 0.5 * load, 0, 0.34 + high),
            (1.12 * high, 0.5),
            (1, 0, 0),
        ),
    )


def boat(p: Proportions) -> Model:
    long, mast = 0.8 * p(), 1.3 * p(0.1)
    hull = box("body", (0, 0, 0.2), (0.72 * long, 0.26, 0.2), (1.25, 1.35))
    shapes = [
        hull,
        cone("body", (0.6 * long, 0, 0.24), (1.35 * long, 0, 0.36), 0.24),
        limb("dark", (0.05, 0, 0.3), (0.05, 0, mast), 0.045),
    ]
    sail = box("part", (-0.3, 0, 0.5 + 0.38 * mast), (0.36 * p(), 0.03, 0.36 * mast), (0.08, 1.0))
    sheared = sail.vertices + np.outer(sail.vertices[:, 2] - 0.5, [0.28, 0, 0])
    shapes += [sail._replace(vertices=sheared), box("warm", (0, 0, 0.41), (0.7 * long, 0.28, 0.02))]
    shapes += [box("pale", (-0.5 * long, 0, 0.5), (0.16, 0.18, 0.1))]
    return Model(
        shapes, Anchors((0.05, 0, mast - 0.02), 0.2, (0.4 * long, 0, 0.24), (0.26, 0.34), (1, 0, 0))
    )


def plane(p: Proportions) -> Model:
    long, span = 0.8 * p(), 0.85 * p()
    shapes = [
        ellipsoid("body", (0, 0, 0.5), (long, 0.26 * p(), 0.27)),
        ellipsoid("glass", (0.42 * long, 0, 0.71), (0.22, 0.14, 0.12)),
    ]
    shapes += [
        box("part", (0.1, 0, 0.46), (0.2 * p(), span, 0.035)),
        box("part", (-0.85 * long, 0, 0.56), (0.1, 0.34, 0.03)),
    ]
    shapes += [box("part", (-0.86 * long, 0, 0.76), (0.13, 0.03, 0.24), (0.55, 1))]
    shapes += [
        cone("warm", (0.92 * long, 0, 0.5), (long + 0.12, 0, 0.5), 0.1),
        box("dark", (long + 0.06, 0, 0.5), (0.02, 0.05, 0.27)),
    ]
    for s in (-1, 1):
        shapes += [
            limb("dark", (0.2, s * 0.2, 0.4), (0.2, s * 0.25, 0.18), 0.03),
            limb("dark", (0.2, s * 0.2, 0.12), (0.2, s * 0.3, 0.12), 0.11),
        ]
    return Model(
        shapes, Anchors((0.02, 0, 0.75), 0.2, (-0.42 * long, 0, 0.5), (0.25, 0.25), (1, 0, 0))
    )


def house(p: Proportions) -> Model:
    deep, wide, high = 0.5 * p(), 0.6 * p(), 0.36 * p()
    roof = 0.28 * p(0.2)
    top = 2 * high
    shapes = [
        box("body", (0, 0, high), (deep, wide, high)),
        box("part", (0, 0, top + roof), (deep + 0.12, wide + 0.1, roof), (0.04, 0.94)),
    ]
    shapes += [
        box("pale", (deep, 0, 0.27), (0.025, 0.2, 0.27)),
        box("dark", (deep, 0, 0.23), (0.035, 0.14, 0.23)),
        box("warm", (-0.2, 0.3, top + 1.4 * roof), (0.1, 0.1, 0.8 * roof + 0.12)),
    ]
    shapes += [
        box("glass", (deep, s * 0.62 * wide, high * 1.15), (0.025, 0.13, 0.13)) for s in (-1, 1)
    ]
    shapes += [box("glass", (0, s * wide, high * 1.15), (0.15, 0.025, 0.13)) for s in (-1, 1)]
    return Model(
        shapes,
        Anchors((0, 0, top + 2 * roof - 0.04), 0.22, (0, 0, 0.62 * top), (deep * 1.22, wide * 1.2)),
    )


def mug(p: Proportions) -> Model:
    radius, high = 0.44 * p(), 0.95 * p()
    profile = [
        (0, 0),
        (radius, 0),
        (radius * p(0.08), high),
        (0.86 * radius, high),
        (0.84 * radius, 0.12),
    ]
    shapes = [lathe("body", profile), lathe("pale", [(0.84 * radius, 0.1), (0, 0.1)])]
    shapes += [lathe("dark", [(0.85 * radius, 0.78 * high), (0, 0.78 * high)])]
    shapes += [
        ring(
            "part", (radius + 0.02, 0, 0.52 * high), (0.22 * p(), 0.27 * p()), 0.07, axis=(0, -1, 0)
        )
    ]
    return Model(
        shapes,
        Anchors((-0.9 * radius, 0, high), 0.15, (0, 0, 0.5 * high), (radius * 1.02, radius * 1.02)),
    )


def chair(p: Proportions) -> Model:
    half, seat, back = 0.42 * p(), 0.55 * p(), 0.62 * p()
    shapes = [
        box("body", (0, 0, seat), (half, half, 0.06)),
        *legs(half - 0.07, half - 0.07, seat, 0.055),
    ]
    shapes += [box("body", (-half + 0.05, 0, seat + back), (0.05, half, 0.5 * back))]
    shapes += [
        limb(
            "body",
            (-half + 0.05, s * (half - 0.06), seat),
            (-half + 0.05, s * (half - 0.06), seat + back),
            0.05,
        )
        for s in (-1, 1)
    ]
    shapes += [ellipsoid("part", (0.05, 0, seat + 0.1), (0.82 * half, 0.85 * half, 0.09))]
    if p.chance(0.4):
        shapes += [
            box("body", (0, s * (half - 0.04), seat + 0.32), (half, 0.05, 0.04)) for s in (-1, 1)
        ]
        shapes += [
            limb(
                "body",
                (half - 0.05, s * (half - 0.04), seat),
                (half - 0.05, s * (half - 0.04), seat + 0.3),
                0.04,
            )
            for s in (-1, 1)
        ]
    return Model(
        shapes,
        Anchors(
            (-half + 0.05, 0, seat + 1.5 * back),
            0.18,
            (-half + 0.05, 0, seat + 1.05 * back),
            (0.12, half * 1.08),
        ),
    )


def mushroom(p: Proportions) -> Model:
    stem, cap, high = 0.21 * p(), 0.66 * p(), 0.42 * p()
    base = 0.6 * p()
    bend = np.linspace(0, np.pi / 2, 7)
    profile = [(0, base), *zip(cap * np.cos(bend), base + high * np.sin(bend), strict=True)]
    shapes = [
        lathe("body", profile),
        lathe("part", [(0, 0), (stem * 1.35, 0), (stem, 0.3), (stem, base + 0.02)]),
    ]
    shapes += [
        lathe("pale", [(0.97 * cap, base - 0.015), (0, base - 0.015)]),
        ring("pale", (0, 0, 0.72 * base), (stem, stem), 0.06),
    ]
    return Model(
        shapes,
        Anchors((0, 0, base + high - 0.01), 0.22, (0, 0, 0.42 * base), (stem * 1.3, stem * 1.3)),
    )


def robot(p: Proportions) -> Model:
    wide, head = 0.44 * p(), 0.25 * p()
    z = 1.3 + head
    shapes = [
        box("body", (0, 0, 0.84), (0.3, wide, 0.42)),
        box("part", (0, 0, z), (0.9 * head, 1.1 * head, head)),
    ]
    shapes += [
        limb("dark", (0, 0, 1.2), (0, 0, z), 0.1),
        limb("dark", (0, 0, z + head), (0, 0, z + head + 0.2), 0.03),
    ]
    shapes += [
        ellipsoid("warm", (0, 0, z + head + 0.22), (0.07, 0.07, 0.07), rings=6),
        box("pale", (0.3, 0, 0.98), (0.02, 0.5 * wide, 0.13)),
    ]
    shapes += [
        box("dark", (0.9 * head, 0, z - 0.1), (0.02, 0.13, 0.03)),
        *eyes(0.9 * head, 0.12, z + 0.07, 0.065),
    ]
    for s in (-1, 1):
        shapes += [
            limb("part", (0, s * (wide + 0.1), 1.12), (0.1, s * (wide + 0.14), 0.55), 0.08),
            box("dark", (0.04, s * 0.19, 0.06), (0.2, 0.13, 0.06)),
        ]
        shapes += [
            limb("part", (0, s * 0.19, 0.1), (0, s * 0.19, 0.5), 0.09),
            ellipsoid("dark", (0.11, s * (wide + 0.14), 0.49), (0.1, 0.1, 0.1)),
        ]
    return Model(shapes, Anchors((0, 0, z + 0.97 * head), 0.2, (0, 0, 1.28), (0.17, 0.17)))
