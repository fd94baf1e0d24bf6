"""Colours of files as float32 display values in [0, 1]."""

import logging

import numpy as np
from jaxtyping import Float, Shaped

from .mesh import GREY

log = logging.getLogger(__name__)


def unit_rgb(colors: Shaped[np.ndarray, "N C"]) -> Float[np.ndarray, "N 3"]:
    """Convert integer or float colours to RGB in [0, 1]; colours that aren't finite become grey."""
    colors = np.asarray(colors)[:, :3]
    if colors.dtype.kind in "ui":
        return colors.astype(np.float32) / np.iinfo(colors.dtype).max
    if not (finite := np.isfinite(colors).all(axis=1)).all():
        log.warning("%d colours of the mesh aren't finite: they become grey", (~finite).sum())
    return np.where(finite[:, None], colors, GREY).clip(0, 1).astype(np.float32)


def linear_to_srgb(linear: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Return display values by the curve of IEC 61966-2-1; negative ones stay on its line."""
    return np.where(
        linear <= 0.0031308, 12.92 * linear, 1.055 * np.maximum(linear, 0) ** (1 / 2.4) - 0.055
    ).astype(np.float32)


def srgb_to_linear(display: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
    """Invert :func:`linear_to_srgb` for values in [0, 1]."""
    return np.where(display <= 0.04045, display / 12.92, ((display + 0.055) / 1.055) ** 2.4).astype(
        np.float32
    )
