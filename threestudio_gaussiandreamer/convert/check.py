"""The dB of a round trip: a file that was written is read back and rendered beside its source."""

from typing import NamedTuple

import torch

from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.views import EPS2D, render_all, views_around
from ..metrics import psnr

VIEWS = 8


class RoundTrip(NamedTuple):
    """PSNR of a cloud after a round trip to the cloud before."""

    mean: float
    """Over all pixels of all views, dB."""
    worst: float
    """Of the worst view, dB."""


@torch.no_grad()
def round_trip(
    before: StoredCloud, after: StoredCloud, size: int, eps2d: float = EPS2D
) -> RoundTrip:
    """Render both clouds from ``VIEWS`` directions around the first one and compare the images.

    Args:
        size: width and height of the images, pixels.
        eps2d: screen-space dilation, square pixels; both are drawn with or without antialiasing as
            the first one was trained.

    Raises:
        UserError: the cloud is too large to be rendered.
    """
    clouds = [stored.in_axes(before.up).gaussians.tensors() for stored in (before, after)]
    to_z_up = torch.from_numpy(rotation_between(before.up, WORLD_UP))
    views = views_around(clouds[0], VIEWS, size, to_z_up=to_z_up)
    views = views._replace(eps2d=eps2d, antialias=before.antialiased)
    truth, found = (render_all(cloud, views) for cloud in clouds)
    worst = min(float(psnr(*pair)) for pair in zip(found, truth, strict=True))
    return RoundTrip(float(psnr(found, truth)), worst)
