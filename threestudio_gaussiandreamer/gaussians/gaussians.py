"""The type that holds N Gaussians, as NumPy arrays or as tensors, in the encoding of files and
optimisers: logarithms of the scales, logits of the opacities, spherical harmonics for colours."""

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from math import isqrt
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from ..core.errors import UserError
from .sh import COEFFICIENTS, MAX_DEGREE

logger = logging.getLogger(__name__)
Array = np.ndarray | Tensor
MAX_LOG = 87.0
"""Largest stored logit or logarithm of a scale: exp(-87) is about the smallest normal float32."""
SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "sh0": (1, 3),
    "sh_rest": (-1, 3),
}
"""Shape of each parameter without its first dimension, the number of Gaussians; -1 is any size."""


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
        """Collect the attributes with the names of the fields; UserError for missing ones."""
        require_attributes(source, cls._fields)
        return cls(*(getattr(source, name) for name in cls._fields))

    @property
    def sh_degree(self) -> int:
        return round(self.sh.shape[1] ** 0.5) - 1

    def map(self, function: Callable[[Array], Array]) -> "Gaussians":
        """Apply a function to every field."""
        return Gaussians(*map(function, self))

    def rows(self, index: Any) -> "Gaussians":
        """Select Gaussians; ``index`` is anything that indexes the fields' first dimension."""
        return self.map(lambda values: values[index])

    def arrays(self) -> "Gaussians":
        """Convert to float32 arrays, without gradients."""
        return self.map(lambda values: torch.as_tensor(values).detach().float().cpu().numpy())

    def tensors(self, device: torch.device | str = "cpu") -> "Gaussians":
        """Convert to float32 tensors on ``device``."""
        return self.map(lambda values: torch.as_tensor(values).float().to(device))


def require_attributes(source: Any, names: Iterable[str]) -> None:
    """Raise UserError if a geometry, which may be another package's, has no such attributes."""
    if missing := [name for name in names if not hasattr(source, name)]:
        raise UserError(
            f"{type(source).__name__} is no cloud of Gaussians: it has no {', '.join(missing)}; "
            "set system.geometry_type to gaussiandreamer-cloud, or to a geometry derived from it "
            "whose configure calls super().configure()"
        )


def usable(gaussians: Gaussians) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians can be drawn: all their values are finite, except that logits may be
    infinite (opacity 0 or 1) and logarithms of scales may be -inf (scale 0).
    """
    columns = [
        np.isfinite(gaussians.means),
        np.isfinite(gaussians.quats),
        np.isfinite(gaussians.sh).all(axis=2),
        ~np.isnan(gaussians.logit_opacities)[:, None],
        gaussians.log_scales < np.inf,
    ]
    return np.concatenate(columns, axis=1).all(axis=1)


def joined(parts: Sequence[Gaussians]) -> Gaussians:
    """Concatenate arrays of Gaussians; harmonics that a part lacks are zero."""
    if not parts:
        shapes = (0, 3), (0, 4), (0, 3), (0,), (0, 1, 3)
        return Gaussians(*(np.zeros(shape, np.float32) for shape in shapes))
    most = max(part.sh.shape[1] for part in parts)
    pads = [((0, 0), (0, most - part.sh.shape[1]), (0, 0)) for part in parts]
    parts = [part._replace(sh=np.pad(part.sh, pad)) for part, pad in zip(parts, pads, strict=True)]
    return Gaussians(*(np.concatenate(values) for values in zip(*parts, strict=True)))


def drawable(gaussians: Gaussians, name: str) -> Gaussians:
    """Remove the Gaussians that can't be drawn, and harmonics above degree 3, with a warning;
    ``name`` names their file in messages.
    """
    if (degree := gaussians.sh_degree) > MAX_DEGREE:
        most = f"{MAX_DEGREE} is the highest that can be drawn"
        logger.warning("%s: of harmonics of degree %d a part is left out: %s", name, degree, most)
        gaussians = gaussians._replace(sh=gaussians.sh[:, : COEFFICIENTS[-1]])
    keep = usable(gaussians)
    if keep.all():
        return gaussians
    bad = len(keep) - int(keep.sum())
    logger.warning("%s: %d of %d Gaussians hold NaN or infinity: left out", name, bad, len(keep))
    return gaussians.rows(keep)


def finite(gaussians: Gaussians, name: str) -> Gaussians:
    """Remove the Gaussians that can't be drawn, and clamp logits and logarithms of scales to
    [-MAX_LOG, MAX_LOG], so that all values and the scales themselves are finite in float32.
    """
    gaussians = drawable(gaussians, name)
    return gaussians._replace(
        logit_opacities=gaussians.logit_opacities.clip(-MAX_LOG, MAX_LOG),
        log_scales=gaussians.log_scales.clip(-MAX_LOG, MAX_LOG),
    )


def opaque(gaussians: Gaussians, min_opacity: float) -> Bool[np.ndarray, " N"]:
    """Return which Gaussians have an opacity, in [0, 1], of at least ``min_opacity`` (NaN: no)."""
    with np.errstate(divide="ignore"):
        return gaussians.logit_opacities >= np.log(min_opacity) - np.log1p(-min_opacity)


def require_cloud(
    state: Mapping[str, Any],
    names: Mapping[str, str],
    what: str,
    *,
    allow_non_finite: bool = False,
) -> None:
    """Check the tensors of the cloud in a checkpoint.

    Args:
        state: tensors by their name in the file.
        names: the name in ``state`` of each key of ``SHAPES``; those that it lacks are skipped.
        what: names the file in messages.

    Raises:
        UserError: there are no Gaussians, shapes don't agree, a tensor isn't floating point, or
            values are NaN or infinite.
    """
    found = {name: state[stored] for name, stored in names.items() if stored in state}
    means = found.get("means")
    if not isinstance(means, Tensor) or not means.dim() or not len(means):
        raise UserError(f"{what} holds no Gaussian in {names['means']}")
    for name, value in found.items():
        where, wanted = f"{what}: {names[name]}", (len(means), *SHAPES[name])
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        sides = tuple(-1 if side < 0 else found for found, side in zip(shape, wanted, strict=False))
        if len(shape) != len(wanted) or sides != wanted:
            expected = ", ".join("K" if side < 0 else str(side) for side in wanted)
            raise UserError(f"{where} has the shape {shape}; expected ({expected})")
        if not value.is_floating_point() or value.layout != torch.strided:
            raise UserError(f"{where} is of the type {value.dtype}; expected floating point")
        bad = 0 if allow_non_finite else int((~value.isfinite()).sum())
        if bad:
            raise UserError(f"{where} holds {bad} numbers that are NaN or infinite")
    bands = 1 + found["sh_rest"].shape[1] if "sh_rest" in found else 1
    if isqrt(bands) ** 2 != bands:
        raise UserError(f"{what}: {bands} harmonics are no whole degree: expected 1, 4, 9 or 16")
