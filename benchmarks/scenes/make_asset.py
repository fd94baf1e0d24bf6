"""Make the bundled mesh: a painted wind-up toy fox, sitting, 1 unit = half its height.
Deterministic; no input.

    python -m benchmarks.scenes.make_asset [threestudio_gaussiandreamer/assets/toy.glb]

It is a test object as well as a picture: a face, a bib and a scarf's end in front, stripes and a
wind-up key behind (so that a front can't be taken for a back), a tail on its left only, thin parts
(ears, key, tail's tip), paint with edges and fine grain.

Every part is a grid over (u, v), u once around and v along, in world coordinates (z up, front =
+x), with a rectangle of the texture to itself; the paint is a function of the place in space. Faces
inside another part are left out."""

import io
import json
import struct
import sys
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple, Optional

import numpy as np

TEXTURE = 512
# texels between a part's uv and the border of its rectangle, so that bilinear lookups stay inside
MARGIN = 1.5
DEFAULT = Path(__file__).resolve().parents[2] / "threestudio_gaussiandreamer/assets/toy.glb"

ORANGE, RUST, CREAM = (0.97, 0.62, 0.30), (0.78, 0.38, 0.19), (0.98, 0.93, 0.83)
BROWN, BLACK, WHITE, PINK = (
    (0.43, 0.28, 0.23),
    (0.10, 0.08, 0.10),
    (1.0, 1.0, 1.0),
    (0.96, 0.69, 0.66),
)
TEAL, YELLOW, RED, BRASS = (
    (0.20, 0.62, 0.66),
    (1.0, 0.85, 0.42),
    (0.90, 0.28, 0.32),
    (0.88, 0.70, 0.36),
)


class Part(NamedTuple):
    """A closed surface, where it is solid, and how it is painted."""

    place: Callable[[np.ndarray, np.ndarray], np.ndarray]
    """(u, v) in [0, 1] to points (..., 3)."""
    inside: Callable[[np.ndarray], np.ndarray]
    paint: Callable[[np.ndarray], np.ndarray]
    """Points (n, 3) to colours (n, 3) in [0, 1]."""
    grid: tuple[int, int]
    """Faces around and along."""
    texels: tuple[int, int]


# Shapes
# --------------------------------------------------------------------------------------------------


def ellipsoid(center, radii, *, tilt: float = 0.0, taper: float = 0.0) -> tuple[Callable, Callable]:
    """An ellipsoid with vertical poles, tilted forward by ``tilt`` degrees and narrower towards the
    top by ``taper``.
    """
    center, radii, angle = np.array(center), np.array(radii), np.radians(tilt)
    turn = np.array(
        [[np.cos(angle), 0, np.sin(angle)], [0, 1, 0], [-np.sin(angle), 0, np.cos(angle)]]
    )

    def place(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        around, height = 2 * np.pi * u, -np.cos(np.pi * v)
        ring = np.sin(np.pi * v) * (1 - taper * height)
        unit = np.stack(
            [-ring * np.cos(around), -ring * np.sin(around), height], axis=-1
        )  # the seam is behind
        return center + (unit * radii) @ turn.T

    def inside(points: np.ndarray) -> np.ndarray:
        unit = (points - center) @ turn / radii
        unit[:, :2] /= 1 - taper * unit[:, 2:]
        return np.linalg.norm(unit, axis=1) < 0.98

    return place, inside


def tube(
    path, radii, *, flat: float = 1.0, side=(0.0, 1.0, 0.0), closed: bool = False
) -> tuple[Callable, Callable]:
    """A round tube along a smooth path through points, with a radius at each; ``flat`` scales it
    across ``side``.

    Open tubes are rounded off at both ends; their radii are those of the body between.
    """
    curve, width = (
        smooth(np.array(path, float), closed),
        smooth(np.array(radii, float)[:, None], closed),
    )

    def frame(t: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        along = normalized(curve(t + 1e-4) - curve(t - 1e-4))
        across = normalized(np.cross(along, side))
        return along, across, np.cross(across, along)

    def place(u: np.ndarray, v: np.ndarray) -> np.ndarray:
        t, cap, bulge = (v, np.zeros_like(v), np.ones_like(v)) if closed else rounded_ends(v)
        along, across, up = frame(t)
        radius = width(t)
        ring = (
            np.cos(2 * np.pi * u)[..., None] * across * flat + np.sin(2 * np.pi * u)[..., None] * up
        )
        return curve(t) + radius * (bulge[..., None] * ring + cap[..., None] * along)

    samples = np.linspace(0, 1, 200)
    centers, reach = curve(samples), 0.9 * min(flat, 1.0) * width(samples)[:, 0]

    def inside(points: np.ndarray) -> np.ndarray:
        return (np.linalg.norm(points[:, None] - centers, axis=-1) < reach).any(axis=1)

    return place, inside


def rounded_ends(v: np.ndarray, share: float = 0.12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Where along the path v lies, how far out of its end (in radii), and the ring's relative
    radius.
    """
    start, end = np.clip(1 - v / share, 0, 1), np.clip(1 - (1 - v) / share, 0, 1)
    t = np.clip((v - share) / (1 - 2 * share), 0, 1)
    angle = np.pi / 2 * (end - start)
    return t, np.sin(angle), np.cos(angle)


def smooth(knots: np.ndarray, closed: bool) -> Callable[[np.ndarray], np.ndarray]:
    """A Catmull-Rom curve through the knots, t in [0, 1] (periodic when closed, else held at its
    ends).
    """
    padded = (
        np.concatenate([knots[-1:], knots, knots[:2]])
        if closed
        else np.concatenate([2 * knots[:1] - knots[1:2], knots, 2 * knots[-1:] - knots[-2:-1]])
    )
    spans = len(padded) - 3

    def curve(t: np.ndarray) -> np.ndarray:
        place = (np.mod(t, 1) if closed else np.clip(t, 0, 1)) * spans
        index = np.minimum(place.astype(int), spans - 1)
        s = (place - index)[..., None]
        a, b, c, d = (padded[index + i] for i in range(4))
        return 0.5 * (
            2 * b
            + (c - a) * s
            + (2 * a - 5 * b + 4 * c - d) * s**2
            + (3 * b - a - 3 * c + d) * s**3
        )

    return curve


def normalized(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


# Paint
# --------------------------------------------------------------------------------------------------

LATTICE = np.random.default_rng(7).random((16, 16, 16))


def grain(points: np.ndarray, frequency: float) -> np.ndarray:
    """Smooth noise in [0, 1] with features of about 1 / frequency."""
    scaled = points * frequency + 100
    cell = np.floor(scaled).astype(int)
    weight = scaled - cell
    weight = weight**2 * (3 - 2 * weight)
    total = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(corner, weight, 1 - weight), axis=1)
        total += share * LATTICE[tuple(((cell + corner) % 16).T)]
    return total


def blend(base: np.ndarray, color, amount: np.ndarray) -> np.ndarray:
    """``color`` laid over ``base`` where ``amount`` is 1."""
    amount = np.clip(amount, 0, 1)[:, None]
    return base * (1 - amount) + np.asarray(color) * amount


def within(signed: np.ndarray, softness: float = 0.02) -> np.ndarray:
    """1 where ``signed`` is negative, 0 where positive, with a soft edge of that width."""
    return np.clip(0.5 - signed / softness, 0, 1)


def fur(points: np.ndarray, color) -> np.ndarray:
    """``color`` with strands that run down and a broad mottle."""
    strands = grain(points * [1, 1, 0.25], 26) - 0.5
    mottle = grain(points + 3, 5) - 0.5
    return np.clip(np.asarray(color) * (1 + 0.12 * strands + 0.16 * mottle)[:, None], 0, 1)


def disc(points: np.ndarray, center, radius: float, squash: float = 1.0) -> np.ndarray:
    """Signed distance of (y, z) from a disc ``squash`` times as high as wide."""
    offset = (points[:, 1:] - center) / [1, squash]
    return np.linalg.norm(offset, axis=1) - radius


def paint_body(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = fur(points, ORANGE)
    waves = np.sin(15 * z + 3 * np.abs(y) + 1.5 * grain(points, 4))
    color = blend(
        color, RUST, within(0.25 - waves, 0.5) * within(x + 0.05, 0.06)
    )  # stripes, behind only
    bib = np.hypot(y / 0.25, (z + 0.36) / 0.34) - 1
    front = x > 0
    color = blend(color, fur(points, CREAM), within(bib, 0.06) * front)
    stitches = within(np.abs(bib + 0.1) - 0.028, 0.04) * within(
        -np.sin(20 * np.arctan2(y / 0.25, (z + 0.36) / 0.34)), 0.8
    )
    color = blend(color, BROWN, stitches * front)
    return blend(color, RED, within(heart(y - 0.07, z + 0.33, 0.075), 0.012) * front)


def heart(x: np.ndarray, y: np.ndarray, size: float) -> np.ndarray:
    """About the signed distance from a heart."""
    x, y = np.abs(x) / size, y / size + 0.2
    return (np.hypot(x, y - 0.75 * np.sqrt(x + 1e-9)) - 1) * size


def paint_head(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    front, side = x > 0.05, np.abs(y)
    color = fur(points, ORANGE)
    color = blend(
        color,
        RUST,
        within(0.3 - np.sin(17 * side + 1.2 * grain(points, 5)), 0.5)
        * within(x + 0.02, 0.06)
        * within(0.2 - z, 0.1),
    )
    mask = z - (0.30 + 0.16 * np.clip(side / 0.3, 0, 1) ** 1.5) + 0.5 * np.clip(0.12 - x, 0, 1)
    color = blend(color, fur(points, CREAM), within(mask, 0.02) * within(-x, 0.05))  # cheeks
    color = blend(
        color,
        RUST,
        within(side - 0.028 * (1 + 6 * np.clip(z - 0.45, 0, 1)), 0.02)
        * within(0.42 - z, 0.03)
        * front,
    )  # blaze
    for sign in (-1, 1):
        eye = np.array([0.165 * sign, 0.435])
        color = blend(color, WHITE, within(disc(points, eye, 0.082, 1.15)) * front)
        color = blend(
            color, BROWN, within(disc(points, eye - [0.012 * sign, 0.008], 0.066, 1.15)) * front
        )
        color = blend(
            color, BLACK, within(disc(points, eye - [0.015 * sign, 0.012], 0.046, 1.15)) * front
        )
        color = blend(color, WHITE, within(disc(points, eye + [0.012, 0.03], 0.017)) * front)
        color = blend(
            color, PINK, within(disc(points, [0.29 * sign, 0.285], 0.05, 0.7), 0.05) * front
        )
        brow = disc(points, [0.17 * sign, 0.59], 0.06, 0.25)
        color = blend(color, BROWN, within(brow) * front)
    return color


def paint_snout(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = blend(fur(points, CREAM), ORANGE, within(0.335 + 0.25 * np.abs(y) - z, 0.03))
    mouth = np.abs(z - (0.235 + 0.35 * np.abs(y) - 0.9 * y**2))
    color = blend(
        color, BROWN, within(mouth - 0.007) * within(0.44 - x, 0.02) * within(np.abs(y) - 0.11)
    )
    color = blend(
        color, BROWN, within(np.abs(y) - 0.006) * within(0.235 - z) * within(0.5 - x, 0.02)
    )
    for sign in (-1, 1):
        for dy, dz in ((0.07, 0.275), (0.1, 0.3), (0.105, 0.262)):
            color = blend(
                color, BROWN, within(disc(points, [sign * dy, dz], 0.011), 0.014) * (x > 0.42)
            )
    return color


def paint_ear(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = blend(
        fur(points, ORANGE), BROWN, within(0.86 + 0.06 * (grain(points, 14) - 0.5) - z, 0.02)
    )
    across = np.abs(np.abs(y) - (0.27 + 0.3 * (z - 0.6)))
    inner = across - 0.095 * np.clip((0.9 - z) / 0.3, 0, 1)
    return blend(color, PINK, within(inner, 0.02) * within(-x - 0.005, 0.02))


def paint_limb(points: np.ndarray, end: np.ndarray, reach: float) -> np.ndarray:
    """Orange with a dark, gloved end."""
    distance = np.linalg.norm(points - end, axis=1)
    return blend(
        fur(points, ORANGE),
        fur(points, BROWN),
        within(distance - reach + 0.04 * (grain(points, 16) - 0.5), 0.02),
    )


def paint_foot(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = blend(
        fur(points, BROWN),
        fur(points, ORANGE),
        within(x - 0.16 + 0.04 * (grain(points, 16) - 0.5), 0.02),
    )
    offset = np.abs(np.abs(y) - 0.25)
    color = blend(
        color,
        CREAM,
        within(np.abs(offset - 0.045) - 0.006) * within(0.40 - x, 0.02) * within(-0.78 - z, 0.02),
    )  # toes
    pad = np.hypot(offset, z + 0.83) - 0.05
    return blend(color, PINK, within(pad) * within(0.42 - x, 0.02))


def paint_thigh(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = fur(points, ORANGE)
    color = blend(
        color,
        RUST,
        within(0.35 - np.sin(22 * z + 9 * x + grain(points, 4)), 0.5) * within(x + 0.02, 0.05),
    )
    patch = (
        np.maximum(np.abs(x - 0.08), np.abs(z + 0.58)) - 0.085
    )  # a sewn-on patch, on the right only
    right = y < -0.3
    checks = within(np.sin(50 * (x - 0.08)) * np.sin(50 * (z + 0.58)), 0.5)
    color = blend(
        color, blend(np.tile(TEAL, (len(points), 1)), YELLOW, checks), within(patch) * right
    )
    return blend(color, CREAM, within(np.abs(patch - 0.01) - 0.008) * right)


def paint_tail(points: np.ndarray) -> np.ndarray:
    y, z = points[:, 1], points[:, 2]
    along = z + 0.35 * y + 0.05 * (grain(points, 9) - 0.5)
    color = blend(fur(points, ORANGE), RUST, within(0.3 - np.sin(20 * along), 0.5))
    return blend(color, fur(points, CREAM), within(0.1 - along, 0.02))


def paint_scarf(points: np.ndarray) -> np.ndarray:
    """Knitted, in stripes around the neck."""
    x, y, z = points.T
    return knit(points, np.arctan2(y, x - 0.05) * 8 / np.pi)


def paint_scarf_end(points: np.ndarray) -> np.ndarray:
    """Stripes and a fringe."""
    color = knit(points, -10 * points[:, 2])
    return blend(
        color, CREAM, within(-np.sin(90 * points[:, 1]), 0.6) * within(points[:, 2] + 0.37)
    )


def knit(points: np.ndarray, stripe: np.ndarray) -> np.ndarray:
    """Two colours in turn, each as wide as 1 of ``stripe``, with the rows of a coarse yarn."""
    color = blend(np.tile(TEAL, (len(points), 1)), YELLOW, within(np.sin(np.pi * stripe), 0.35))
    rows = np.sin(70 * points[:, 2] + 6 * grain(points, 8))
    return np.clip(color * (1 + 0.06 * rows)[:, None], 0, 1)


def paint_brass(points: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(BRASS) * (0.85 + 0.3 * grain(points, 12))[:, None], 0, 1)


def paint_nose(points: np.ndarray) -> np.ndarray:
    color = np.tile(np.asarray(BLACK), (len(points), 1))
    return blend(color, WHITE, 0.9 * within(disc(points, [0.012, 0.362], 0.014)))


# The fox
# --------------------------------------------------------------------------------------------------


def fox() -> list[Part]:
    """All parts, the largest first."""
    parts = [
        Part(*ellipsoid((0.06, 0, 0.40), (0.37, 0.43, 0.34)), paint_head, (40, 26), (300, 190)),
        Part(
            *ellipsoid((0, 0, -0.40), (0.36, 0.37, 0.50), taper=0.22),
            paint_body,
            (40, 26),
            (210, 190),
        ),
        Part(*tube(TAIL, (0.07, 0.13, 0.19, 0.19, 0.13, 0.02)), paint_tail, (20, 30), (120, 130)),
        Part(
            *tube(NECK, [0.088] * 8, closed=True, side=(0, 0, 1)), paint_scarf, (10, 48), (44, 130)
        ),
        Part(
            *tube(
                [(0.30, -0.15, 0.02), (0.385, -0.19, -0.14), (0.40, -0.21, -0.40)],
                (0.075, 0.085, 0.095),
                flat=0.3,
            ),
            paint_scarf_end,
            (14, 12),
            (96, 84),
        ),
        Part(
            *ellipsoid((0.43, 0, 0.28), (0.21, 0.17, 0.13), tilt=-6),
            paint_snout,
            (24, 16),
            (120, 76),
        ),
        Part(*ellipsoid((0.625, 0, 0.335), (0.05, 0.06, 0.045)), paint_nose, (12, 8), (28, 20)),
        Part(
            *tube([(-0.30, 0, -0.22), (-0.56, 0, -0.22)], (0.03, 0.03)),
            paint_brass,
            (10, 6),
            (16, 16),
        ),
    ]
    for sign in (-1, 1):
        hand = np.array([0.40, 0.19 * sign, -0.50])
        ear = [(0.02, 0.25 * sign, 0.60), (0.0, 0.30 * sign, 0.78), (-0.03, 0.37 * sign, 1.0)]
        arm = [(0.12, 0.27 * sign, -0.12), (0.30, 0.33 * sign, -0.34), hand]
        loop = [
            (-0.60, sign * (0.085 + 0.075 * np.cos(a)), -0.22 + 0.085 * np.sin(a))
            for a in np.arange(8) * np.pi / 4
        ]
        parts += [
            Part(*tube(ear, (0.15, 0.125, 0.02), flat=0.4), paint_ear, (18, 14), (90, 70)),
            Part(
                *tube(arm, (0.10, 0.09, 0.10)),
                lambda p, hand=hand: paint_limb(p, hand, 0.14),
                (16, 14),
                (76, 72),
            ),
            Part(
                *ellipsoid((0.06, 0.26 * sign, -0.66), (0.27, 0.17, 0.25)),
                paint_thigh,
                (22, 14),
                (90, 66),
            ),
            Part(
                *ellipsoid((0.30, 0.25 * sign, -0.84), (0.23, 0.13, 0.13)),
                paint_foot,
                (20, 14),
                (90, 56),
            ),
            Part(
                *tube(loop, [0.024] * 8, closed=True, side=(1, 0, 0)),
                paint_brass,
                (8, 20),
                (12, 40),
            ),
        ]
    return parts


TAIL = [
    (-0.22, 0.05, -0.80),
    (-0.42, 0.28, -0.84),
    (-0.52, 0.56, -0.66),
    (-0.50, 0.70, -0.32),
    (-0.40, 0.70, 0.02),
    (-0.30, 0.62, 0.30),
]
NECK = [
    (0.05 + 0.29 * np.cos(a), 0.31 * np.sin(a), 0.07 - 0.04 * np.cos(a))
    for a in np.arange(8) * np.pi / 4
]


# Assembly
# --------------------------------------------------------------------------------------------------


def build(parts: list[Part]) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Vertices (V, 3), texture coordinates (V, 2) with v downwards, faces (F, 3) and the texture
    (512, 512, 3) in [0, 1].
    """
    texture = np.full((TEXTURE, TEXTURE, 3), 0.5)
    vertices, uvs, faces, count = [], [], [], 0
    for index, (part, corner) in enumerate(
        zip(parts, pack([part.texels for part in parts]), strict=True)
    ):
        points, uv, triangles = surface(part, corner)
        hidden = np.any(
            [other.inside(points) for i, other in enumerate(parts) if i != index], axis=0
        )
        triangles = triangles[~hidden[triangles].all(axis=1)]
        used, triangles = np.unique(triangles, return_inverse=True)
        vertices.append(points[used])
        uvs.append(uv[used])
        faces.append(triangles.reshape(-1, 3) + count)
        count += len(used)
        paint(part, corner, texture)
    return np.concatenate(vertices), np.concatenate(uvs), np.concatenate(faces), texture


def surface(part: Part, corner: tuple[int, int]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A part's grid: points, texture coordinates and faces that turn outwards."""
    around, along = part.grid
    v, u = np.meshgrid(np.arange(along + 1) / along, np.arange(around + 1) / around, indexing="ij")
    points = part.place(u, v).reshape(-1, 3)
    texels = np.array(part.texels)
    uv = (
        np.array(corner) + MARGIN + np.stack([u, v], axis=-1).reshape(-1, 2) * (texels - 2 * MARGIN)
    ) / TEXTURE
    start = (np.arange(along)[:, None] * (around + 1) + np.arange(around)).reshape(-1)
    quads = np.stack([start, start + 1, start + around + 2, start + around + 1], axis=1)
    triangles = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
    a, b, c = np.moveaxis(points[triangles], 1, 0)
    normals = np.cross(b - a, c - a)
    solid = np.linalg.norm(normals, axis=1) > 1e-9  # not the empty ones at the poles
    outwards = (normals * (a - points.mean(axis=0))).sum() > 0
    return points, uv, triangles[solid] if outwards else triangles[solid][:, ::-1]


def paint(part: Part, corner: tuple[int, int], texture: np.ndarray) -> None:
    """Fill a part's rectangle: each texel by the place in space that it covers."""
    (width, height), (left, top) = part.texels, corner
    rows, columns = np.meshgrid(np.arange(height) + 0.5, np.arange(width) + 0.5, indexing="ij")
    u = (columns - MARGIN) / (width - 2 * MARGIN)
    v = np.clip((rows - MARGIN) / (height - 2 * MARGIN), 0, 1)
    colors = part.paint(part.place(u, v).reshape(-1, 3))
    texture[top : top + height, left : left + width] = colors.reshape(height, width, 3)


def pack(sizes: list[tuple[int, int]]) -> list[tuple[int, int]]:
    """Corners (left, top) of rectangles on shelves, the highest first."""
    corners: list[Optional[tuple[int, int]]] = [None] * len(sizes)
    left = top = shelf = 0
    for index in sorted(range(len(sizes)), key=lambda i: -sizes[i][1]):
        width, height = sizes[index]
        if left + width > TEXTURE:
            left, top, shelf = 0, top + shelf, 0
        corners[index] = (left, top)
        left, shelf = left + width, max(shelf, height)
    if top + shelf > TEXTURE:
        raise ValueError(f"the parts need {top + shelf} rows of texels, there are {TEXTURE}")
    return corners


def write_glb(
    path: Path, vertices: np.ndarray, uv: np.ndarray, faces: np.ndarray, texture: np.ndarray
) -> None:
    """A minimal glTF 2.0 binary: one textured primitive; y up, front +z."""
    from PIL import Image

    image = io.BytesIO()
    colors = Image.fromarray((texture * 255).round().astype(np.uint8)).quantize(
        256, kmeans=2, method=Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE
    )
    colors.save(image, "PNG", optimize=True)
    positions = vertices[:, [1, 2, 0]].astype("<f4")  # x, y, z of the file are the world's y, z, x
    chunks = [
        positions.tobytes(),
        uv.astype("<f4").tobytes(),
        faces.astype("<u2").tobytes(),
        image.getvalue(),
    ]
    offsets = np.cumsum([0] + [len(padded(chunk)) for chunk in chunks])
    views = [
        {"buffer": 0, "byteOffset": int(offset), "byteLength": len(chunk)}
        for offset, chunk in zip(offsets[:-1], chunks, strict=True)
    ]
    accessors = [
        {
            "bufferView": 0,
            "componentType": 5126,
            "count": len(vertices),
            "type": "VEC3",
            "min": positions.min(0).tolist(),
            "max": positions.max(0).tolist(),
        },
        {"bufferView": 1, "componentType": 5126, "count": len(uv), "type": "VEC2"},
        {"bufferView": 2, "componentType": 5123, "count": faces.size, "type": "SCALAR"},
    ]
    document = {
        "asset": {"version": "2.0", "generator": "make_asset.py", "copyright": "Apache-2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": "toy fox"}],
        "meshes": [
            {
                "primitives": [
                    {"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "indices": 2, "material": 0}
                ]
            }
        ],
        "materials": [
            {
                "pbrMetallicRoughness": {
                    "baseColorTexture": {"index": 0},
                    "metallicFactor": 0,
                    "roughnessFactor": 0.9,
                }
            }
        ],
        "textures": [{"source": 0}],
        "images": [{"bufferView": 3, "mimeType": "image/png"}],
        "accessors": accessors,
        "bufferViews": views,
        "buffers": [{"byteLength": int(offsets[-1])}],
    }
    text = padded(json.dumps(document, separators=(",", ":")).encode(), b" ")
    data = b"".join(map(padded, chunks))
    header = struct.pack("<4sII", b"glTF", 2, 12 + 8 + len(text) + 8 + len(data))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(
        header
        + struct.pack("<I4s", len(text), b"JSON")
        + text
        + struct.pack("<I4s", len(data), b"BIN\0")
        + data
    )


def padded(chunk: bytes, fill: bytes = b"\0") -> bytes:
    """Filled up to a multiple of four bytes, as glTF aligns its parts."""
    return chunk + fill * (-len(chunk) % 4)


def main() -> None:
    path = Path(sys.argv[1]) if len(sys.argv) > 1 else DEFAULT
    vertices, uv, faces, texture = build(fox())
    write_glb(path, vertices, uv, faces, texture)
    print(
        f"{path}: {len(vertices)} vertices, {len(faces)} triangles, "
        f"{path.stat().st_size / 1000:.0f} kB"
    )


if __name__ == "__main__":
    main()
