"""Round the attributes of a cloud in the steps of SPZ."""

from collections.abc import Callable

import numpy as np

from threestudio_gaussiandreamer.formats.spz import COLOR_SCALE
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians


def steps_of(values: np.ndarray, low: float, high: float, levels: float) -> np.ndarray:
    """Round ``values`` to ``levels`` equal steps from ``low`` to ``high``."""
    scaled = (values.astype(np.float64).clip(low, high) - low) / (high - low)
    return (low + (high - low) * np.rint(scaled * levels) / levels).astype(np.float32)


def with_positions(arrays: Gaussians, bits: int) -> Gaussians:
    low = float(arrays.means.min())
    return arrays._replace(
        means=steps_of(
            arrays.means, low, low + float(np.ptp(arrays.means, axis=0).max()) * 2, 2 ** (bits + 1)
        )
    )


def with_scales(arrays: Gaussians, bits: int) -> Gaussians:
    return arrays._replace(log_scales=steps_of(arrays.log_scales, -10, 6, 2**bits))


def with_rotation(arrays: Gaussians, bits: int) -> Gaussians:
    """Round the three smallest components to sign and magnitude; the largest follows."""
    quats = arrays.quats / np.linalg.norm(arrays.quats, axis=1, keepdims=True)
    largest = np.arange(4) == np.abs(quats).argmax(1)[:, None]
    quats *= np.sign(quats[largest])[:, None]
    rounded = np.where(
        largest, 0, steps_of(quats, -np.sqrt(0.5), np.sqrt(0.5), 2 * (2 ** (bits - 1) - 1))
    )
    rest = np.sqrt((1 - (rounded**2).sum(1, keepdims=True)).clip(0))
    return arrays._replace(quats=np.where(largest, rest, rounded).astype(np.float32))


def with_opacity(arrays: Gaussians, bits: int) -> Gaussians:
    levels, half_step = 2**bits - 1, 0.125 / (2**bits - 1)
    alphas = steps_of(
        1 / (1 + np.exp(-arrays.logit_opacities.astype(np.float64))), 0, 1, levels
    ).clip(half_step, 1 - half_step)
    return arrays._replace(logit_opacities=np.log(alphas / (1 - alphas)).astype(np.float32))


def with_colour(arrays: Gaussians, bits: int) -> Gaussians:
    reach = 0.5 / COLOR_SCALE
    return arrays._replace(sh=steps_of(arrays.sh, -reach, reach, 2**bits - 1))


ROUNDED: dict[str, Callable[[Gaussians, int], Gaussians]] = {
    "opacity": with_opacity,
    "colour": with_colour,
    "scales": with_scales,
    "rotation": with_rotation,
    "positions": with_positions,
}
