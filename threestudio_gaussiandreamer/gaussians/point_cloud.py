"""The point cloud that a prior returns, from which the Gaussians are initialised."""

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

    def followed_by(self, other: "PointCloud") -> "PointCloud":
        """Append the points of ``other``, without its faces; normals are kept if both have them."""
        both = self.normals is not None and other.normals is not None
        return PointCloud(
            points=np.concatenate([self.points, other.points]).astype(np.float32),
            colors=np.concatenate([self.colors, other.colors]).astype(np.float32),
            normals=np.concatenate([self.normals, other.normals]) if both else None,
            faces=self.faces,
        )

    def split(self, count: int) -> tuple["PointCloud", "PointCloud"]:
        """Return the first ``count`` points, with the faces, and the remaining ones."""
        first, rest = (
            PointCloud(*(None if values is None else values[rows] for values in self[:3]))
            for rows in (slice(count), slice(count, None))
        )
        return first._replace(faces=self.faces), rest
