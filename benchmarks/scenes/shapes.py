"""Closed surfaces over (u, v), u once around and v along, in world coordinates."""

from collections.abc import Callable

import numpy as np


def ellipsoid(center, radii, *, tilt: float = 0.0, taper: float = 0.0) -> tuple[Callable, Callable]:
    """Return an ellipsoid with vertical poles, tilted forward by ``tilt`` degrees and narrower
    towards the top by ``taper``.
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
    """Return a round tube along a smooth path through points, with a radius at each; ``flat``
    scales it across ``side``.

    Open tubes have rounded ends; their radii are those of the body between.
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
    """Return the position along the path of v, the distance beyond its end (in radii), and the
    ring's relative radius.
    """
    start, end = np.clip(1 - v / share, 0, 1), np.clip(1 - (1 - v) / share, 0, 1)
    t = np.clip((v - share) / (1 - 2 * share), 0, 1)
    angle = np.pi / 2 * (end - start)
    return t, np.sin(angle), np.cos(angle)


def smooth(knots: np.ndarray, closed: bool) -> Callable[[np.ndarray], np.ndarray]:
    """Evaluate a Catmull-Rom curve through the knots, t in [0, 1] (periodic if closed, else clamped
    at its ends).
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
