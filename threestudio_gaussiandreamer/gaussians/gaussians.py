"""The type that holds N Gaussians, as NumPy arrays or as tensors, in the encoding of files and
optimisers: logarithms of the scales, logits of the opacities, spherical harmonics for colours."""

import logging
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ..core.errors import UserError
from .sh import MAX_DEGREE

logger = logging.getLogger(__name__)
Array = np.ndarray | Tensor
MAX_LOG = 87.0
"""Logits and logarithms of scales are stored within this: exp(-87) is about the smallest normal
float32, and the sigmoid of +-87 is 1 and 0.
"""


class Gaussians(NamedTuple):
    """N Gaussians; all fields are arrays, or all are tensors on one device."""

    means: Array
    """(N, 3) world units."""
    quats: Array
    """(N, 4) wxyz, not normalised."""
    log_scales: Array
    """(N, 3) logarithms of the standard deviations, world units."""
    logit_opacities: Array
    """(N,)"""
    sh: Array
    """(N, K, 3) spherical harmonics, K = (degree + 1)^2."""

    @classmethod
    def of(cls, source: Any) -> "Gaussians":
        """Collect the attributes of these names, for instance those of a geometry."""
        return cls(*(getattr(source, name) for name in cls._fields))

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def map(self, function: Callable[[Array], Array]) -> "Gaussians":
        """Apply a function to every field."""
        return Gaussians(*map(function, self))

    def rows(self, index: Any) -> "Gaussians":
        """Select Gaussians by whatever indexes the fields' first dimension."""
        return self.map(lambda values: values[index])

    def arrays(self) -> "Gaussians":
        """Convert to float32 arrays, without gradients."""
        return self.map(lambda values: torch.as_tensor(values).detach().float().cpu().numpy())

    def tensors(self, device: torch.device | str = "cpu") -> "Gaussians":
        """Convert to float32 tensors on ``device``."""
        return self.map(lambda values: torch.as_tensor(values).float().to(device))


def usable(gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Tell which Gaussians can be drawn: all values are finite, but for opacities of 0 or 1 and
    flat axes, whose logarithms are infinite.
    """
    columns = [
        np.isfinite(gaussians.means),
        np.isfinite(gaussians.quats),
        np.isfinite(gaussians.sh).all(axis=2),
        ~np.isnan(gaussians.logit_opacities)[:, None],
        gaussians.log_scales < np.inf,
    ]
    return np.concatenate(columns, axis=1).all(axis=1)


def drawable(gaussians: Gaussians, name: str) -> Gaussians:
    """Leave out the Gaussians that can't be drawn, with a warning; ``name`` says where they are.

    Raises:
        UserError: harmonics above degree 3, which neither the rasteriser nor SPZ has.
    """
    if gaussians.sh_degree > MAX_DEGREE:
        raise UserError(
            f"{name}: the Gaussians have harmonics of degree {gaussians.sh_degree}; expected 0 to "
            f"{MAX_DEGREE}"
        )
    keep = usable(gaussians)
    if keep.all():
        return gaussians
    bad = len(keep) - int(keep.sum())
    logger.warning("%s: %d of %d Gaussians hold NaN or infinity: left out", name, bad, len(keep))
    return gaussians.rows(keep)


def finite(gaussians: Gaussians, name: str) -> Gaussians:
    """Return Gaussians of which every value is finite: those that can't be drawn are left out, and
    logits and logarithms stay finite, those of scales also when a reader takes the exponential.
    """
    gaussians = drawable(gaussians, name)
    return gaussians._replace(
        logit_opacities=gaussians.logit_opacities.clip(-MAX_LOG, MAX_LOG),
        log_scales=gaussians.log_scales.clip(-MAX_LOG, MAX_LOG),
    )


def opaque(gaussians: Gaussians, min_opacity: float) -> Bool[np.ndarray, " N"]:
    """Tell which Gaussians have an opacity of at least ``min_opacity``, in [0, 1]; at 0 all whose
    opacity is a number.
    """
    with np.errstate(divide="ignore"):
        return gaussians.logit_opacities >= np.log(min_opacity) - np.log1p(-min_opacity)
