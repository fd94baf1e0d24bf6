"""The dB of a round trip: a file that was written is read back and rendered beside its source."""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.views import Views, render_all, views_around
from ..metrics import psnr

VIEWS = 8


class RoundTrip(NamedTuple):
    """PSNR of a cloud after a round trip to the cloud before."""

    mean: float
    """Over all pixels of all views, dB."""
    worst: float
    """Of the worst view, dB."""


class Reference(NamedTuple):
    """A cloud before a round trip, and its renders."""

    up: str
    """The axis of the cloud that is up."""
    views: Views
    images: Float[Tensor, "V H W 3"]


@torch.no_grad()
def reference(before: StoredCloud, size: int) -> Reference:
    """Render a cloud from ``VIEWS`` directions around it, with or without antialiasing as it was
    trained.

    Args:
        size: width and height of the images, pixels.

    Raises:
        UserError: the cloud is too large to be rendered.
    """
    cloud = before.gaussians.tensors()
    to_z_up = torch.from_numpy(rotation_between(before.up, WORLD_UP))
    views = views_around(cloud, VIEWS, size, to_z_up=to_z_up)
    views = views._replace(antialias=before.antialiased)
    return Reference(before.up, views, render_all(cloud, views))


@torch.no_grad()
def compare(truth: Reference, after: StoredCloud) -> RoundTrip:
    """Render the cloud after the round trip likewise, and compare the images."""
    found = render_all(after.in_axes(truth.up).gaussians.tensors(), truth.views)
    worst = min(float(psnr(*pair)) for pair in zip(found, truth.images, strict=True))
    return RoundTrip(float(psnr(found, truth.images)), worst)


def round_trip(before: StoredCloud, after: StoredCloud, size: int) -> RoundTrip:
    """Compare two clouds by :func:`reference` and :func:`compare`."""
    return compare(reference(before, size), after)
