"""Functions for priors with a network: placing their points in the world, choosing a device, and
random generators.
"""

import numpy as np
import torch

from ..core.errors import UserError
from ..core.options import one_of
from ..gaussians.grow import longest_side
from ..gaussians.point_cloud import PointCloud
from ..meshes.load import AXES

HORIZONTAL = ("+x", "-x", "+y", "-y")


FRONT = one_of(HORIZONTAL)


def placed(cloud: PointCloud, *, front: str, scale: float, normalize: bool) -> PointCloud:
    """Return ``cloud``, which has z up, rotated so that ``front`` becomes +x, and scaled.

    Args:
        scale: world units per unit of the cloud; with ``normalize``, half the longest side of the
            bounding box in world units.
        normalize: centre the bounding box at the origin, and scale it to ``scale``.
    """
    axis = AXES[front]
    points = (
        np.asarray(cloud.points, np.float64)
        @ np.stack([axis, np.cross(AXES["+z"], axis), AXES["+z"]]).T
    )
    if normalize:
        points = (points - (points.min(axis=0) + points.max(axis=0)) / 2) / (
            longest_side(points) / 2 or 1.0
        )
    return cloud._replace(points=(scale * points).astype(np.float32))


def chosen_device(name: str, default: torch.device) -> torch.device:
    """Return the device called ``name``, or the run's for "auto".

    Raises:
        UserError: there is no such device.
    """
    if name == "auto":
        return torch.device(default)
    try:
        torch.empty(0, device=name)
        return torch.device(name)
    except (RuntimeError, AssertionError) as error:  # a CPU build of PyTorch asserts
        raise UserError(
            f"device: {name!r} can't be used here ({str(error).splitlines()[0]}): give 'auto', "
            "'cpu' or 'cuda'"
        ) from error


def torch_generator(generator: np.random.Generator) -> torch.Generator:
    """Return a CPU generator of torch whose seed is drawn from ``generator``."""
    return torch.Generator().manual_seed(int(generator.integers(2**62)))
