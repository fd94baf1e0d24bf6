"""Encodings that several compact formats of Gaussians share: bytes, logits, spatial order."""

import logging
from typing import Any

import numpy as np
from jaxtyping import Float, Integer

from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import rgb_to_sh0, sh0_to_rgb
from ..meshes.mesh import linear_to_srgb

log = logging.getLogger(__name__)
ANTIALIASED = "SplatRenderMode: mip"
"""The comment by which other programs tag clouds trained with antialiasing."""
FLOAT_OPACITY_MARGIN = 2.0**-25
"""Opacities from float32 are clamped to this distance from 0 and 1, half a step below 1."""


def morton_order(means: Float[np.ndarray, "N 3"], cube: bool = False) -> Integer[np.ndarray, " N"]:
    """Return the rows in Morton order: by the interleaved bits of positions, 10 bits per axis of
    their box, or of a ``cube`` around it.
    """
    means = means.astype(np.float64)
    low, high = means.min(axis=0, initial=np.inf), means.max(axis=0, initial=-np.inf)
    size = (high - low).max() if cube else high - low
    cells = ((means - low) / np.maximum(size, 1e-12) * 1023).astype(np.int64)
    bits = cells[:, :, None] >> np.arange(10) & 1
    codes = (bits << (3 * np.arange(10) + np.arange(3)[:, None])).sum(axis=(1, 2))
    return codes.argsort(kind="stable")


def unit_quats(quats: Float[np.ndarray, "N 4"]) -> Float[np.ndarray, "N 4"]:
    """Normalise in float64; a zero quaternion becomes the identity."""
    quats = np.array(quats, np.float64)
    lengths = np.linalg.norm(quats, axis=1, keepdims=True)
    return np.where(lengths > 0, quats / np.where(lengths > 0, lengths, 1), [1.0, 0, 0, 0])


def without_largest(
    quats: Float[np.ndarray, "N 4"],
) -> tuple[Integer[np.ndarray, " N"], Float[np.ndarray, "N 3"]]:
    """Return the index of each unit quaternion's largest component, and the other three in their
    order, with the sign that makes the largest positive.
    """
    largest = np.abs(quats).argmax(axis=1)
    signs = np.where(quats[np.arange(len(quats)), largest] < 0, -1, 1)
    others = (quats * signs[:, None])[np.arange(4) != largest[:, None]].reshape(-1, 3)
    return largest, others


def with_largest(
    largest: Integer[np.ndarray, " N"], others: Float[np.ndarray, "N 3"]
) -> Float[np.ndarray, "N 4"]:
    """Invert :func:`without_largest`; the result is float32."""
    quats = np.empty((len(others), 4), np.float32)
    missing = np.arange(4) == largest[:, None]
    quats[~missing] = others.ravel()
    quats[missing] = np.sqrt(np.clip(1 - (others**2).sum(axis=1), 0, 1))
    return quats


def opacities(logits: Float[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Return opacities in [0, 1] as float64."""
    from scipy.special import expit

    return expit(logits.astype(np.float64))


def opacity_bytes(logits: Float[np.ndarray, " N"], most: int = 254) -> Integer[np.ndarray, " N"]:
    """Return opacities in steps of 1 / 255, up to ``most``; some readers' logit of 255 is inf."""
    return to_byte(255 * opacities(logits)).clip(max=most)


def logits_of_bytes(alphas: Integer[np.ndarray, " N"]) -> Float[np.ndarray, " N"]:
    """Return logits of opacities in steps of 1 / 255, an eighth of a step away from 0 and 1."""
    return logits(alphas / 255, 1 / 2040)


def logits(values: Float[np.ndarray, " N"], margin: float) -> Float[np.ndarray, " N"]:
    """Return the logits of opacities, which are clamped to [margin, 1 - margin]; NaN stays."""
    from scipy.special import logit

    return logit(np.clip(values.astype(np.float64), margin, 1 - margin)).astype(np.float32)


def is_linear(space: Any) -> bool:
    """Return whether a colour space's name is that of linear light, as "lin_rec709_display"."""
    return "lin" in str(space).lower()


def displayed(gaussians: Gaussians, name: str) -> Gaussians:
    """Return Gaussians whose harmonics are of linear light with those of display values, and log
    it, with the file's ``name``: exact for the constant part, by sRGB's slope there for the others.
    """
    log.warning("%s: linear colours become sRGB; blended edges look a little different", name)
    linear = sh0_to_rgb(gaussians.sh[:, :1]).clip(0)
    power = 1.055 / 2.4 * np.maximum(linear, 0.0031308) ** (1 / 2.4 - 1)
    slope = np.where(linear <= 0.0031308, 12.92, power)
    sh = (gaussians.sh * slope).astype(np.float32)
    sh[:, :1] = rgb_to_sh0(linear_to_srgb(linear))
    return gaussians._replace(sh=sh)


def to_byte(values: Float[np.ndarray, "*shape"]) -> Integer[np.ndarray, "*shape"]:
    """Round to integers, clipped to [0, 255]."""
    return np.rint(np.clip(values, 0, 255)).astype("u1")
