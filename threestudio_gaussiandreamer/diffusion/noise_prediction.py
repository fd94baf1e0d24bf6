"""Formulas on noise predictions: conversions of a network's output, Perp-Neg, and rescaling.

Notation of ``sds.py``: z = sqrt(abar) x0 + sqrt(1 - abar) eps."""

from jaxtyping import Float
from torch import Tensor

from .rectified_flow import noise_of_velocity
from .sds import per_item, predict_x0

PREDICTIONS = {
    "epsilon": lambda output, z, abar: output,
    "v_prediction": lambda output, z, abar: (
        per_item(abar.sqrt(), z) * output + per_item((1 - abar).sqrt(), z) * z
    ),
    "velocity": lambda output, z, abar: noise_of_velocity(output, z, abar),
    "sample": lambda output, z, abar: (
        (z - per_item(abar.sqrt(), z) * output) / per_item((1 - abar).sqrt(), z)
    ),
}
"""Conversions of the network's output to the noise, by prediction type: the noise itself,
v = sqrt(abar) eps - sqrt(1 - abar) x0 (Salimans and Ho 2022), the velocity eps - x0 of a rectified
flow, or x0.
"""


def perp_neg(
    cond: Float[Tensor, "B c h w"],
    uncond: Float[Tensor, "B c h w"],
    negative: Float[Tensor, "B 2 c h w"],
    weights: Float[Tensor, "B 2"],
) -> Float[Tensor, "B c h w"]:
    """Compute eps_u + d + sum_i w_i (n_i - proj_d n_i), where d = eps_c - eps_u, n_i = eps_i -
    eps_u (Armandpour et al. 2023, eq. 9).

    Classifier-free guidance with scale s turns this into eps_u + s (d + ...), the paper's formula.
    """
    wanted = (cond - uncond)[:, None]
    unwanted = negative - uncond[:, None]
    inner = (unwanted * wanted).sum(dim=(2, 3, 4), keepdim=True)
    length = wanted.square().sum(dim=(2, 3, 4), keepdim=True).clamp_min(1e-6)
    perpendicular = unwanted - inner / length * wanted
    return cond + (weights.to(cond)[:, :, None, None, None] * perpendicular).sum(dim=1)


def rescaled(
    guided: Float[Tensor, "B c h w"],
    cond: Float[Tensor, "B c h w"],
    z: Float[Tensor, "B c h w"],
    abar: Float[Tensor, " B"],
    share: float,
) -> Float[Tensor, "B c h w"]:
    """Rescale the guided noise so that its x0 has the standard deviation of the conditional x0 (Lin
    et al. 2023, arXiv:2305.08891, section 3.4).

    Args:
        share: 0 for no effect, 1 for the full rescaling; linear between.
    """
    x0, reference = predict_x0(z, guided, abar), predict_x0(z, cond, abar)
    factor = _deviation(reference) / _deviation(x0)
    x0 = x0 * (share * factor + 1 - share)
    return PREDICTIONS["sample"](x0, z, abar)


def _deviation(x: Float[Tensor, "B c h w"]) -> Float[Tensor, "B 1 1 1"]:
    return x.std(dim=(1, 2, 3), keepdim=True).clamp_min(1e-8)
