"""Pictures of a mesh from views around it: the modes of the exact score's mixtures."""

from typing import NamedTuple, Optional

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..diffusion.exact_score import LinearLatent
from ..prompts.view_prompts import view_directions
from .known_truth import composite


class Bank(NamedTuple):
    """Pictures of the mesh from random views around it, at one size."""

    rgba: UInt8[Tensor, "K H W 4"]
    """Premultiplied."""
    pooled: Float[Tensor, "K 4 h w"]
    """float32 in [0, 1], averaged over the latent's pixels."""
    latent: LinearLatent


class Mixture(NamedTuple):
    """The modes of one item's mixture distribution."""

    modes: Float[Tensor, "K c h w"]
    log_prior: Optional[Float[Tensor, " K"]]
    """0 for the modes of the conditional mixture, -inf for others, which belong only to the
    unconditional mixture; None if all are conditional and no unconditional mixture is needed.
    """


def direction_indices(
    elevation: Float[Tensor, " B"], azimuth: Float[Tensor, " B"]
) -> Int[Tensor, " B"]:
    """Classify views in degrees by threestudio's rules for view-dependent prompts: 0 side, 1 front,
    2 back, 3 overhead.
    """
    indices = torch.zeros_like(azimuth, dtype=torch.long)
    for index, direction in enumerate(view_directions(45, 45, 60)):
        indices[direction.condition(elevation, azimuth, azimuth)] = index
    return indices


def bank_modes(bank: Bank, background: Float[Tensor, "bh bw 3"]) -> Float[Tensor, "K c h w"]:
    """Encode the bank on a background of one colour (1, 1, 3) or of pixels (H', W', 3)."""
    if background.shape[:2] == (1, 1):  # pooling and compositing commute
        pooled = bank.pooled.to(background.device)
        return bank.latent.encode_pooled(
            pooled[:, :3] + (1 - pooled[:, 3:]) * background.reshape(3, 1, 1)
        )
    return torch.cat(
        [bank.latent.encode(composite(rgba, background[None])) for rgba in bank.rgba.split(16)]
    )


def rows_of(bank: Bank, members: Bool[Tensor, " K"]) -> Bank:
    """Return the marked pictures."""
    members = members.to(bank.rgba.device)
    return (
        bank
        if members.all()
        else bank._replace(rgba=bank.rgba[members], pooled=bank.pooled[members])
    )
