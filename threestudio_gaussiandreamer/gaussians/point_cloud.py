"""The point cloud that a prior returns and that the Gaussians start from."""

from typing import NamedTuple, Optional

import numpy as np


class PointCloud(NamedTuple):
    """Coloured points in world units (z up, azimuth 0 = +x is the front)."""

    points: np.ndarray
    """(P, 3) float32, world units."""
    colors: np.ndarray
    """(P, 3) float32 in [0, 1]."""
    normals: Optional[np.ndarray] = None
    """(P, 3) float32 unit vectors, where known."""
    faces: Optional[np.ndarray] = None
    """(F, 3) int64 into ``points``, where the points are the vertices of a mesh."""
