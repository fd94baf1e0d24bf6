"""Render a turntable of a prior's points as small Gaussians, for inspection."""

import math
import os

import numpy as np
import torch
from jaxtyping import UInt8

from ..cameras import orbit_c2w, to_opencv
from ..core.files import atomic_file
from ..gaussians.grow import nearest_distance_scales
from ..gaussians.point_cloud import PointCloud
from ..splatting import rasterize

ELEVATION, FOVY = 15.0, math.radians(40)
MARGIN = 1.3
"""Camera distance, relative to that at which the points exactly fill the picture."""
SIZE = 0.8
"""Size of a point relative to the distance to its neighbours: the smallest without visible gaps."""
MILLISECONDS = 160
"""Duration of each frame, milliseconds."""


def save_turntable(cloud: PointCloud, path: str | os.PathLike, *, views=12, size=256) -> None:
    """Write an animated GIF of ``cloud`` that begins at its front (azimuth 0) and never stops."""
    from PIL import Image

    pictures = [
        # Pillow's own choice of a palette for a GIF takes twenty times as long
        Image.fromarray(picture).quantize(method=Image.Quantize.FASTOCTREE)
        for picture in turntable(cloud, views=views, size=size)
    ]
    with atomic_file(path) as file:
        options = {"append_images": pictures[1:], "duration": MILLISECONDS, "loop": 0}
        pictures[0].save(file, format="GIF", save_all=True, **options)


@torch.no_grad()
def turntable(cloud: PointCloud, *, views: int, size: int) -> UInt8[np.ndarray, "V S S 3"]:
    """Return pictures of ``cloud`` on white from ``views`` azimuths, the first from the front; all
    of it is in each.
    """
    points = np.asarray(cloud.points, np.float32)
    centre = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - centre, axis=1).max()) or 1.0
    means = torch.from_numpy((points - centre) / radius)
    scales = np.float32(SIZE / radius) * nearest_distance_scales(points, "rms3")
    scales = torch.from_numpy(scales)[:, None].expand(-1, 3)
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(len(means), 4)
    azimuths = torch.arange(views) * (360.0 / views)
    distance = torch.full_like(azimuths, MARGIN / math.sin(FOVY / 2))
    c2w = orbit_c2w(torch.full_like(azimuths, ELEVATION), azimuths, distance)
    viewmats, Ks = to_opencv(c2w, torch.full_like(azimuths, FOVY), size, size)
    colors = torch.from_numpy(np.asarray(cloud.colors, np.float32))
    inputs = (means, quats, scales, torch.full((len(means),), 0.95), colors)
    white, cameras = torch.ones(3), zip(viewmats.split(1), Ks.split(1), strict=True)
    pictures = [rasterize(*inputs, *cam, size, size, background=white).image for cam in cameras]
    return (255 * torch.cat(pictures).clamp(0, 1)).round().to(torch.uint8).numpy()
