"""``random-prior``: points without any shape, the start that the paper's ablation compares with.

============  ==============================================================================
option        meaning
============  ==============================================================================
shape         ``sphere`` (a ball) or ``box`` (a cube), filled uniformly, centred
num_points    how many
size          its radius or half side, world units
color         ``random`` (uniform in [0, 1]), ``grey`` (null too) or [r, g, b]
ground, ...   see ``priors/base.py``
============  ==============================================================================

Limits: the prompt is not read, and no view is told from another, so expect several faces.
"""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.options import one_of
from ..gaussians.point_cloud import PointCloud
from ..host import register
from .base import COLOR, SCALE, Prior, chosen_colors, points


def in_sphere(count: int, generator: np.random.Generator) -> Float[np.ndarray, "P 3"]:
    """Return points uniform in the unit ball: a uniform direction, a radius of uniform cube."""
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(generator.random((count, 1)))


SHAPES = {"sphere": in_sphere, "box": lambda count, rng: rng.uniform(-1.0, 1.0, (count, 3))}


@register("random-prior")
class RandomPrior(Prior):
    """Points uniform in a ball or a cube."""

    @dataclass
    class Config(Prior.Config):
        shape: str = field(default="sphere", metadata=one_of(SHAPES))
        num_points: int = field(default=10_000, metadata=points(1))
        size: float = field(default=1.0, metadata=SCALE)
        color: Any = field(default="random", metadata=COLOR)

    cfg: Config

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        points = self.cfg.size * SHAPES[self.cfg.shape](self.cfg.num_points, generator)
        return PointCloud(points, chosen_colors(self.cfg.color, len(points), generator))
