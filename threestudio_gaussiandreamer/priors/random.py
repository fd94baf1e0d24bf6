"""``random-prior``: points without any shape, the start that the paper's ablation compares with.

============  ==============================================================================
option        meaning
============  ==============================================================================
shape         ``sphere`` (a ball) or ``box`` (a cube), filled uniformly, centred
num_points    how many
size          its radius or half side, world units
color         ``random`` (uniform in [0, 1]), ``grey`` or [r, g, b]
ground, ...   see ``priors/base.py``
============  ==============================================================================

Limits: the prompt is not read, and no view is told from another, so expect several faces.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from ..core.errors import UserError, unknown
from ..gaussians.point_cloud import PointCloud
from ..host import register
from .base import Prior, chosen_colors, require_color, require_positive


def in_sphere(count: int, generator: np.random.Generator) -> Float[np.ndarray, "P 3"]:
    """Points uniform in the unit ball: a uniform direction, and a radius whose cube is uniform."""
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    return directions * np.cbrt(generator.random((count, 1)))


def in_box(count: int, generator: np.random.Generator) -> Float[np.ndarray, "P 3"]:
    """Points uniform in the cube [-1, 1]³."""
    return generator.uniform(-1.0, 1.0, (count, 3))


SHAPES = {"sphere": in_sphere, "box": in_box}


@register("random-prior")
class RandomPrior(Prior):
    """Points uniform in a ball or a cube."""

    @dataclass
    class Config(Prior.Config):
        shape: str = "sphere"
        num_points: int = 10_000
        size: float = 1.0
        color: Any = "random"

        @staticmethod
        def check(cfg: Any) -> None:
            Prior.Config.check(cfg)
            if cfg.shape not in SHAPES:
                raise unknown("shape", cfg.shape, SHAPES)
            require_positive(cfg, "num_points", "size")
            require_color(cfg)
            if cfg.color is None:
                raise UserError(
                    "color: random points have no colours of their own; expected 'random', "
                    "'grey' or [red, green, blue]"
                )

    cfg: Config

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        points = self.cfg.size * SHAPES[self.cfg.shape](self.cfg.num_points, generator)
        return PointCloud(
            points=points, colors=chosen_colors(self.cfg.color, len(points), generator)
        )
