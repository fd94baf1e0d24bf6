"""Helpers of the CLIP similarity tests."""

import numpy as np

from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


def blob(center=(0.0, 0.0, 0.0), color=(0.9, 0.1, 0.1), count=40, seed=0):
    """Return a few opaque Gaussians around ``center``."""
    rng = np.random.default_rng(seed)
    return Gaussians(
        means=np.float32(np.array(center) + 0.3 * rng.normal(size=(count, 3))),
        sh=np.tile(((np.float32(color) - 0.5) / 0.28209479)[None, None], (count, 1, 1)),
        logit_opacities=np.full(count, 4.0, np.float32),
        log_scales=np.full((count, 3), np.log(0.15), np.float32),
        quats=np.tile(np.float32([1, 0, 0, 0]), (count, 1)),
    )


def save(path, arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_cloud(str(path), StoredCloud(arrays))
    return path
