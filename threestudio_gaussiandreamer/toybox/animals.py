"""The animals among the kinds: see ``kinds.py``."""

import numpy as np

from .parts import Anchors, Model, Proportions, eyes, legs
from .shapes import cone, ellipsoid, lathe, limb, ring


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
    return Model(shapes, Anchors(hat, 0.2, neck, (0.24, 0.24), (0.75, 0, 0.65)))


def rabbit(p: Proportions) -> Model:
    fat, head = 0.4 * p(), 0.31 * p()
    z = 1.02 * p(0.06)
    shapes = [
        ellipsoid("body", (-0.05, 0, 0.45), (fat * 1.1, fat, 0.46)),
        ellipsoid("body", (0.16, 0, z), (head, 0.9 * head, 0.95 * head)),
    ]
    ears = 0.62 * p(0.2)
    for s in (-1, 1):
        shapes += [
            ellipsoid(
                "part",
                (0.06, s * 0.15, z + 0.75 * head + 0.5 * ears),
                (0.07, 0.11, 0.55 * ears),
                axis=(-0.12, s * 0.2, 1),
            )
        ]
        shapes += [
            ellipsoid("body", (0.32, s * 0.24, 0.12), (0.3, 0.13, 0.12)),
            limb("body", (0.2, s * 0.2, 0.6), (0.42, s * 0.17, 0.32), 0.09),
        ]
    shapes += [
        ellipsoid("pale", (-fat - 0.14, 0, 0.34), (0.16, 0.16, 0.16)),
        *eyes(0.16 + 0.88 * head, 0.13, z + 0.08, 0.055),
    ]
    shapes += [ellipsoid("warm", (0.16 + head, 0, z - 0.04), (0.06, 0.07, 0.05), rings=6)]
    return Model(
        shapes,
        Anchors(
            (0.1, 0, z + 0.85 * head), 0.2, (0.07, 0, z - 0.82 * head), (0.29, 0.28), (0.15, 0, 1)
        ),
    )


def bear(p: Proportions) -> Model:
    fat, head = 0.46 * p(), 0.36 * p()
    z = 1.2 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.6), (0.9 * fat, fat, 0.52)),
        ellipsoid("body", (0.05, 0, z), (0.92 * head, head, 0.9 * head)),
    ]
    shapes += [ellipsoid("part", (0.5 * fat, 0, 0.58), (0.5 * fat, 0.68 * fat, 0.36))]
    for s in (-1, 1):
        shapes += [ellipsoid("body", (0, s * 0.78 * head, z + 0.75 * head), (0.09, 0.15, 0.15))]
        shapes += [
            ellipsoid(
                "body",
                (0.14, s * (fat + 0.08), 0.72),
                (0.14, 0.14, 0.32),
                axis=(0.35, s * -0.35, 1),
            )
        ]
        shapes += [
            limb("body", (0.05, s * 0.25, 0.3), (0.4, s * 0.32, 0.13), 0.18, 0.17),
            ellipsoid("pale", (0.44, s * 0.33, 0.13), (0.06, 0.14, 0.14)),
        ]
    shapes += [
        ellipsoid("pale", (0.05 + 0.85 * head, 0, z - 0.08), (0.15, 0.17, 0.13)),
        *eyes(0.05 + 0.86 * head, 0.15, z + 0.1, 0.05),
    ]
    shapes += [ellipsoid("dark", (0.18 + 0.85 * head, 0, z - 0.03), (0.06, 0.07, 0.05), rings=6)]
    return Model(
        shapes, Anchors((0.03, 0, z + 0.82 * head), 0.24, (0.03, 0, z - 0.8 * head), (0.32, 0.33))
    )


def duck(p: Proportions) -> Model:
    length, head = 0.6 * p(), 0.27 * p()
    z = 0.98 * p(0.08)
    shapes = [
        ellipsoid("body", (0, 0, 0.42), (length, 0.42 * p(), 0.36)),
        ellipsoid("body", (0.42, 0, z), (head, head, head)),
    ]
    shapes += [
        limb("body", (0.36, 0, 0.5), (0.41, 0, z), 0.22, 0.17),
        cone("body", (-0.7 * length, 0, 0.5), (-1.35 * length, 0, 0.82), 0.2),
    ]
    for s in (-1, 1):
        shapes += [ellipsoid("part", (-0.06, s * 0.38, 0.5), (0.38, 0.09, 0.22), axis=(-0.2, 0, 1))]
        shapes += [
            ellipsoid("warm", (0.1, s * 0.2, 0.04), (0.2, 0.12, 0.04)),
            limb("warm", (0.03, s * 0.2, 0.05), (0.03, s * 0.2, 0.25), 0.04),
        ]
    shapes += [
        ellipsoid("warm", (0.42 + 1.2 * head, 0, z - 0.05), (0.24, 0.15, 0.06)),
        *eyes(0.42 + 0.78 * head, 0.16, z + 0.09, 0.05),
    ]
    return Model(
        shapes,
        Anchors(
            (0.4, 0, z + 0.85 * head), 0.19, (0.39, 0, z - 0.95 * head), (0.22, 0.22), (0.1, 0, 1)
        ),
    )


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
        shapes += [
            ellipsoid(
                "part",
                (x - 0.1, s * (head + 0.16), z + 0.06),
                (0.06, 0.3 * p(), 0.34),
                axis=(0.25, 0, 1),
            )
        ]
        shapes += [
            limb("pale", (x + 0.25, s * 0.16, z - 0.18), (x + 0.56, s * 0.2, z - 0.24), 0.05, 0.03)
        ]
    shapes += [
        *eyes(x + 0.84 * head, 0.2, z + 0.1, 0.05),
        limb("dark", (-0.64, 0, 0.86), (-0.82, 0, 0.45), 0.035),
    ]
    return Model(
        shapes,
        Anchors((x - 0.05, 0, z + 0.85 * head), 0.24, (0.45, 0, 0.86), (0.42, 0.4), (1, 0, 0.35)),
    )


def penguin(p: Proportions) -> Model:
    fat, head = 0.42 * p(), 0.3 * p()
    z = 1.18 * p(0.06)
    shapes = [
        ellipsoid("body", (0, 0, 0.6), (0.88 * fat, fat, 0.58)),
        ellipsoid("body", (0.02, 0, z), (head, head, head)),
    ]
    shapes += [ellipsoid("part", (0.42 * fat, 0, 0.56), (0.56 * fat, 0.74 * fat, 0.46))]
    for s in (-1, 1):
        shapes += [
            ellipsoid(
                "body",
                (-0.02, s * (fat + 0.07), 0.62),
                (0.15, 0.06, 0.4 * p()),
                axis=(0, s * -0.4, 1),
            )
        ]
        shapes += [ellipsoid("warm", (0.2, s * 0.18, 0.05), (0.24, 0.14, 0.06))]
    shapes += [
        cone("warm", (0.9 * head, 0, z - 0.02), (0.9 * head + 0.3 * p(), 0, z - 0.07), 0.1),
        *eyes(0.85 * head, 0.14, z + 0.1, 0.05),
    ]
    return Model(
        shapes, Anchors((0, 0, z + 0.85 * head), 0.21, (0.02, 0, z - 0.85 * head), (0.27, 0.28))
    )


def turtle(p: Proportions) -> Model:
    length = 0.66 * p()
    wide = 0.55 * p()
    bend = np.linspace(0, np.pi / 2, 7)
    profile = [(0.0, 0.16), *zip(np.cos(bend) * 1.0, 0.16 + 0.5 * p() * np.sin(bend), strict=True)]
    shell = lathe("body", profile)
    stretched = shell._replace(
        vertices=shell.vertices * [length, wide, 1.0], uv=shell.uv * (length + wide) / 2
    )
    x = length + 0.26
    shapes = [
        stretched,
        ring("part", (0, 0, 0.18), (length * 0.96, wide * 0.96), 0.09, height=0.08),
    ]
    shapes += [
        ellipsoid("part", (x, 0, 0.46), (0.29, 0.23, 0.22)),
        limb("part", (0.7 * length, 0, 0.2), (x, 0, 0.42), 0.14),
    ]
    shapes += [
        ellipsoid("part", (i * 0.5, j * (wide + 0.06), 0.1), (0.22, 0.17, 0.1))
        for i in (-1, 1)
        for j in (-1, 1)
    ]
    shapes += [
        cone("part", (-0.9 * length, 0, 0.16), (-length - 0.28, 0, 0.1), 0.1),
        *eyes(x + 0.2, 0.15, 0.55, 0.055),
    ]
    return Model(
        shapes,
        Anchors(
            (0, 0, profile[-1][1]), 0.24, (0.82 * length + 0.1, 0, 0.3), (0.2, 0.2), (1, 0, 0.5)
        ),
    )
