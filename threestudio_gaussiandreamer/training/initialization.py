"""Initialise the Gaussians of a run: grow the prior's points and place a Gaussian on each, or take
those of a trained cloud.
"""

import logging
import math
from dataclasses import dataclass, field
from typing import Any, List

import numpy as np
import torch

from ..core.memory import count_of
from ..core.options import at_least, interval, positive
from ..core.streams import numpy_generator
from ..gaussians import sh
from ..gaussians.gaussians import Gaussians
from ..gaussians.grow import grow, nearest_distance_scales
from ..gaussians.point_cloud import PointCloud
from ..gaussians.simplify import keep_best, view_importance
from ..gaussians.views import views_around
from ..host import run_seed

logger = logging.getLogger(__name__)
CAP_VIEWS = (32, 256)
"""Views that rank the Gaussians of a trained cloud that is too large, and their pixels each way."""


@dataclass
class GrowConfig:
    enabled: bool = True
    num_candidates: int = field(default=1_000_000, metadata=count_of("candidates", 0, 48))
    radius: float = field(default=0.01, metadata=positive(most=100))
    color_range: List[float] = field(default_factory=lambda: [0.0, 0.2], metadata=interval())
    clamp: bool = True
    max_points: int = field(default=400_000, metadata=at_least(0))


def grow_points(cloud: PointCloud, cfg: GrowConfig, ground: int = 0) -> PointCloud:
    """Grow points and perturb their colours (the paper's Algorithm 1), within ``max_points``.

    Args:
        ground: how many points at the end of ``cloud`` are a prior's ground: they neither grow
            nor count for the box, and stay at the end.
    """
    if not cfg.enabled:
        return cloud
    if ground:
        figure, layer = cloud.split(len(cloud.points) - ground)
        return grow_points(figure, cfg).followed_by(layer)
    options = {k: v for k, v in vars(cfg).items() if k not in ("enabled", "color_range")}
    rng = numpy_generator(run_seed(), "grow")
    return grow(cloud, color_range=tuple(cfg.color_range), **options, generator=rng)


def gaussians_on_points(cloud: PointCloud, cfg: Any) -> Gaussians:
    """Make one Gaussian of each point: its colour, opacity ``init_opacity``, an isotropic scale
    from the nearest distances.

    Args:
        cfg: the geometry's, for ``max_gaussians``, ``scale_rule``, ``scale_factor`` and
            ``init_opacity``.
    """
    points, colors = _capped(cloud.points, cloud.colors, cfg.max_gaussians)
    scales = nearest_distance_scales(points, cfg.scale_rule) * cfg.scale_factor
    colors = torch.from_numpy(np.ascontiguousarray(colors, np.float32))
    return Gaussians(
        means=points,
        quats=np.tile(np.float32([1, 0, 0, 0]), (len(points), 1)),
        log_scales=np.repeat(np.log(scales)[:, None], 3, 1),
        logit_opacities=np.full(len(points), math.log(cfg.init_opacity / (1 - cfg.init_opacity))),
        sh=sh.rgb_to_sh0(colors).numpy()[:, None],
    )


def _capped(
    points: np.ndarray, colors: np.ndarray, max_gaussians: int
) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most ``max_gaussians`` points, seeded and uniformly.

    All points have the same opacity and aren't trained yet, so that selecting by contribution to
    renders would prefer outer ones and leave holes (tests/stability measures both).
    """
    if len(points) <= max_gaussians:
        return points, colors
    logger.warning(
        "the prior and its growth give %d points; keeping %d, evenly (max_gaussians)",
        len(points),
        max_gaussians,
    )
    rng = numpy_generator(run_seed(), "cap")
    rows = np.sort(rng.choice(len(points), max_gaussians, replace=False))
    return points[rows], colors[rows]


def most_visible(cloud: Gaussians, max_gaussians: int, device: torch.device) -> Gaussians:
    """Select at most ``max_gaussians`` of a trained cloud: those with the largest contribution to
    views from all around, which are rendered on ``device``.
    """
    if len(cloud.means) <= max_gaussians:
        return cloud
    logger.warning(
        "the prior has %d Gaussians; keeping the %d that contribute most (max_gaussians)",
        len(cloud.means),
        max_gaussians,
    )
    cloud = cloud.tensors(device)
    importance = view_importance(cloud, views_around(cloud, *CAP_VIEWS))
    return keep_best(cloud, importance, max_gaussians)
