"""A ball of Gaussians: red in front (+x), green on its left (+y), blue on top (+z)."""

import numpy as np

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0


def sphere_points(count):
    """Return points that are spread evenly over the unit sphere."""
    index = np.arange(count) + 0.5
    z, azimuth = 1 - 2 * index / count, np.pi * (1 + 5**0.5) * index
    ring = np.sqrt(1 - z**2)
    return np.stack([ring * np.cos(azimuth), ring * np.sin(azimuth), z], axis=1)


def painted_ball(count=600, radius=0.8, opacity=0.95):
    """Return opaque Gaussians on a sphere, coloured by their direction."""
    directions = sphere_points(count)
    size = 1.4 * radius / np.sqrt(count)
    return opaque_cloud(radius * directions, 0.5 + 0.4 * directions, size, opacity)


def opaque_cloud(means, colors, size, opacity):
    """Return spheres of a size and an opacity."""
    count = len(means)
    return Gaussians(
        means=means.astype(np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
        log_scales=np.full((count, 3), np.log(size), np.float32),
        logit_opacities=np.full(count, np.log(opacity / (1 - opacity)), np.float32),
        sh=rgb_to_sh0(colors.astype(np.float32))[:, None],
    )
