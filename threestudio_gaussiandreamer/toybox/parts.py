"""Helpers of the kinds: random proportions, anchors of accessories, common parts."""

from typing import NamedTuple

import numpy as np

from .shapes import Shape, ellipsoid, limb


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


class Model(NamedTuple):
    """The output of a kind's function."""

    shapes: list[Shape]
    anchors: Anchors


class Proportions:
    """Random proportions around 1: ``p(spread)`` is uniform in [1 - spread, 1 + spread]."""

    def __init__(self, rng: np.random.Generator) -> None:
        self._rng = rng

    def __call__(self, spread: float = 0.12) -> float:
        return float(self._rng.uniform(1 - spread, 1 + spread))

    def chance(self, share: float) -> bool:
        """Draw true with probability ``share``."""
        return bool(self._rng.random() < share)


def eyes(x: float, y: float, z: float, radius: float) -> list[Shape]:
    return [
        ellipsoid("dark", (x, side * y, z), (radius, radius, radius), rings=6) for side in (-1, 1)
    ]


def legs(x: float, y: float, top: float, radius: float, role: str = "body") -> list[Shape]:
    return [
        limb(role, (i * x, j * y, 0), (i * x, j * y, top), radius) for i in (-1, 1) for j in (-1, 1)
    ]


def wheels(x: float, y: float, radius: float) -> list[Shape]:
    """Make four wheels with pale hubs."""
    wheels = []
    for i in (-1, 1):
        for j in (-1, 1):
            inner, outer = (
                np.array([i * x, j * (y - 0.08), radius]),
                np.array([i * x, j * (y + 0.08), radius]),
            )
            wheels += [
                limb("dark", inner, outer, radius),
                limb("pale", outer, outer + [0, j * 0.02, 0], 0.5 * radius),
            ]
    return wheels
