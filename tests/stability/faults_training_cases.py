"""Helpers of the tests of training faults."""

import numpy as np

from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.training.geometry import GaussianCloud


def ball(n: int = 300) -> PointCloud:
    rng = np.random.default_rng(0)
    points = rng.normal(size=(n, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points.astype(np.float32), rng.random((n, 3), np.float32))


def started(**options) -> GaussianCloud:
    geometry = GaussianCloud({"grow": {"enabled": False}, **options})
    geometry.start_from(ball())
    return geometry
