"""``body-prior``: a posed human body (SMPL-like, any triangle mesh), as the paper starts from a
text-to-motion model.

============  ======================================================================================
option        meaning
============  ======================================================================================
path          the posed body as a mesh file; the package brings none, since SMPL may not be passed
              on
scale         half the longest side (the height, when it stands), world units; the released code's
              is about 1.7
up, front     the file's axes, ``+x`` to ``-z``; ``auto`` and null: by the kind of file (see
              ``meshes/load.py``)
producer      the program that wrote the file (docs/formats.md), instead of ``up`` and ``front``
num_points    points uniform over the surface (the released code), or 0 for the vertices (the paper)
color         ``random`` (the paper), ``grey``, [r, g, b] in [0, 1], or null for the mesh's own
              colours
ground, ...   see ``priors/base.py``
============  ======================================================================================

The points are recentred by their mean. Random colours are uniform in [0, 1]: the released code
divides its random numbers by 255 before it takes them for spherical harmonics, so that every colour
is between 0.5000 and 0.5011, a flat grey. ``color: grey`` gives that.

Limits: the prompt is not read; the pose is the file's. At ``scale`` above 1.5 the nearest cameras
of the paper's range (1.5 to 4.0) are inside the body."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..core.files import existing_file
from ..gaussians.point_cloud import PointCloud
from ..host import register
from .base import COLOR, points
from .mesh import MeshFilePrior, colored_cloud


@register("body-prior")
class BodyPrior(MeshFilePrior):
    """Points on a posed body, randomly coloured."""

    @dataclass
    class Config(MeshFilePrior.Config):
        num_points: int = field(default=50_000, metadata=points(0))
        color: Any = field(default="random", metadata=COLOR)

    cfg: Config

    def preflight(self) -> None:
        existing_file(self.cfg.path, "body mesh")  # no bundled mesh is a body
        super().preflight()

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        cloud = colored_cloud(self.load(), self.cfg, generator)
        return cloud._replace(points=cloud.points - cloud.points.mean(axis=0))
