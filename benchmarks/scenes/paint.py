"""The fox's paint: colours in [0, 1], (n, 3), as functions of points (n, 3) in space."""

import numpy as np

ORANGE = (0.97, 0.62, 0.30)
RUST = (0.78, 0.38, 0.19)
CREAM = (0.98, 0.93, 0.83)
BROWN = (0.43, 0.28, 0.23)
BLACK = (0.10, 0.08, 0.10)
WHITE = (1.0, 1.0, 1.0)
PINK = (0.96, 0.69, 0.66)
TEAL = (0.20, 0.62, 0.66)
YELLOW = (1.0, 0.85, 0.42)
RED = (0.90, 0.28, 0.32)
BRASS = (0.88, 0.70, 0.36)

LATTICE = np.random.default_rng(7).random((16, 16, 16))


def grain(points: np.ndarray, frequency: float) -> np.ndarray:
    """Return smooth noise in [0, 1] with features of about 1 / frequency."""
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
    """Blend ``color`` over ``base`` where ``amount`` is 1."""
    amount = np.clip(amount, 0, 1)[:, None]
    return base * (1 - amount) + np.asarray(color) * amount


def within(signed: np.ndarray, softness: float = 0.02) -> np.ndarray:
    """Return 1 where ``signed`` is negative, 0 where positive, with a soft edge of that width."""
    return np.clip(0.5 - signed / softness, 0, 1)


def fur(points: np.ndarray, color) -> np.ndarray:
    """Return ``color`` with strands that run down and a broad mottle."""
    strands = grain(points * [1, 1, 0.25], 26) - 0.5
    mottle = grain(points + 3, 5) - 0.5
    return np.clip(np.asarray(color) * (1 + 0.12 * strands + 0.16 * mottle)[:, None], 0, 1)


def disc(points: np.ndarray, center, radius: float, squash: float = 1.0) -> np.ndarray:
    """Return the signed distance of (y, z) from a disc ``squash`` times as high as wide."""
    offset = (points[:, 1:] - center) / [1, squash]
    return np.linalg.norm(offset, axis=1) - radius


def body(points: np.ndarray) -> np.ndarray:
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
    """Return approximately the signed distance from a heart."""
    x, y = np.abs(x) / size, y / size + 0.2
    return (np.hypot(x, y - 0.75 * np.sqrt(x + 1e-9)) - 1) * size


def head(points: np.ndarray) -> np.ndarray:
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


def snout(points: np.ndarray) -> np.ndarray:
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


def ear(points: np.ndarray) -> np.ndarray:
    x, y, z = points.T
    color = blend(
        fur(points, ORANGE), BROWN, within(0.86 + 0.06 * (grain(points, 14) - 0.5) - z, 0.02)
    )
    across = np.abs(np.abs(y) - (0.27 + 0.3 * (z - 0.6)))
    inner = across - 0.095 * np.clip((0.9 - z) / 0.3, 0, 1)
    return blend(color, PINK, within(inner, 0.02) * within(-x - 0.005, 0.02))


def limb(points: np.ndarray, end: np.ndarray, reach: float) -> np.ndarray:
    """Paint orange with a dark, gloved end."""
    distance = np.linalg.norm(points - end, axis=1)
    return blend(
        fur(points, ORANGE),
        fur(points, BROWN),
        within(distance - reach + 0.04 * (grain(points, 16) - 0.5), 0.02),
    )


def foot(points: np.ndarray) -> np.ndarray:
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


def thigh(points: np.ndarray) -> np.ndarray:
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


def tail(points: np.ndarray) -> np.ndarray:
    y, z = points[:, 1], points[:, 2]
    along = z + 0.35 * y + 0.05 * (grain(points, 9) - 0.5)
    color = blend(fur(points, ORANGE), RUST, within(0.3 - np.sin(20 * along), 0.5))
    return blend(color, fur(points, CREAM), within(0.1 - along, 0.02))


def scarf(points: np.ndarray) -> np.ndarray:
    """Paint knitted stripes around the neck."""
    x, y, z = points.T
    return knit(points, np.arctan2(y, x - 0.05) * 8 / np.pi)


def scarf_end(points: np.ndarray) -> np.ndarray:
    """Paint stripes and a fringe."""
    color = knit(points, -10 * points[:, 2])
    return blend(
        color, CREAM, within(-np.sin(90 * points[:, 1]), 0.6) * within(points[:, 2] + 0.37)
    )


def knit(points: np.ndarray, stripe: np.ndarray) -> np.ndarray:
    """Alternate two colours, each as wide as 1 of ``stripe``, with the rows of a coarse yarn."""
    color = blend(np.tile(TEAL, (len(points), 1)), YELLOW, within(np.sin(np.pi * stripe), 0.35))
    rows = np.sin(70 * points[:, 2] + 6 * grain(points, 8))
    return np.clip(color * (1 + 0.06 * rows)[:, None], 0, 1)


def brass(points: np.ndarray) -> np.ndarray:
    return np.clip(np.asarray(BRASS) * (0.85 + 0.3 * grain(points, 12))[:, None], 0, 1)


def nose(points: np.ndarray) -> np.ndarray:
    color = np.tile(np.asarray(BLACK), (len(points), 1))
    return blend(color, WHITE, 0.9 * within(disc(points, [0.012, 0.362], 0.014)))
