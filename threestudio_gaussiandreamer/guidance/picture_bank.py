"""Pictures of a mesh from views around it: the modes of the exact score's mixtures."""

from typing import NamedTuple, Optional

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..diffusion.exact_score import LinearLatent, images_per_chunk, squared_norms
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
    norms: Optional[Float[Tensor, " K"]] = None
    """``squared_norms`` of the modes; None for a single one, which needs no distances."""


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


def mixture_of(
    own: Optional[Float[Tensor, "V c h w"]],
    bank: Bank,
    members: Bool[Tensor, " K"],
    background: Float[Tensor, "bh bw 3"],
) -> Mixture:
    """Return a mixture of encoded pictures, if any, and of the marked ones of a bank.

    Args:
        background: what the bank is composited on: one colour (1, 1, 3) or pixels (H', W', 3).
    """
    rows = members.nonzero().flatten().to(bank.rgba.device)
    own = _encoded(bank, rows[:0], background) if own is None else own
    modes = own.new_empty(len(own) + len(rows), *own.shape[1:])
    norms = own.new_empty(len(modes), dtype=torch.float64)
    modes[: len(own)], norms[: len(own)] = own, squared_norms(own.flatten(1))
    first = len(own)
    for some in rows.split(images_per_chunk(bank.rgba[0].numel(), background.device)):
        place = slice(first, first + len(some))
        modes[place] = _encoded(bank, some, background)
        norms[place] = squared_norms(modes[place].flatten(1))
        first = place.stop
    return Mixture(modes, None, norms)


def _encoded(
    bank: Bank, rows: Int[Tensor, " k"], background: Float[Tensor, "bh bw 3"]
) -> Float[Tensor, "k c h w"]:
    if background.shape[:2] != (1, 1):
        return bank.latent.encode(composite(bank.rgba.index_select(0, rows), background[None]))
    # pooling and compositing commute
    pooled = bank.pooled.index_select(0, rows).to(background.device)
    on_color = pooled[:, :3] + (1 - pooled[:, 3:]) * background.reshape(3, 1, 1)
    return bank.latent.encode_pooled(on_color)
