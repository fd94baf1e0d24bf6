"""Pictures of a mesh from views around it: the modes of the exact score's mixtures."""

from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from ..diffusion.exact_score import (
    ImageTensor,
    LinearLatent,
    expanded_distances,
    images_per_chunk,
    squared_distances,
    weighted_sum,
)
from ..prompts.view_prompts import view_directions
from .known_truth import composite


class Pictures(NamedTuple):
    """Encoded pictures, each a linear combination of its layers: channel c of picture k is
    ``sum_l mixing[c, l] layers[k, l]``.

    Over a colour, the layers are the picture over black and the share of the colour in each pixel.
    Distances follow from scalar products with the layers, so a bank needn't be composited on the
    colour of each item.
    """

    layers: Float[Tensor, "K l h w"]
    products: Float[Tensor, "K l l"]
    """Scalar products of each picture's layers, float64."""

    @staticmethod
    def of(layers: Float[Tensor, "K l h w"]) -> "Pictures":
        wide = [part.double() for part in _chunks(layers)]
        return Pictures(layers, torch.cat([part @ part.mT for part in wide]))


class Bank(NamedTuple):
    """Pictures of the mesh from random views around it, at one size."""

    rgba: UInt8[Tensor, "K H W 4"]
    """Premultiplied."""
    pictures: Pictures
    """Over a colour."""
    latent: LinearLatent

    @staticmethod
    def of(
        rgba: UInt8[Tensor, "K H W 4"], pooled: Float[Tensor, "K 4 h w"], latent: LinearLatent
    ) -> "Bank":
        """Encode pictures, which ``pooled`` has as averages over the latent's pixels, in [0, 1]."""
        # pooling and compositing commute
        layers = torch.cat([latent.encode_pooled(pooled[:, :3]), 1 - pooled[:, 3:]], dim=1)
        return Bank(rgba, Pictures.of(layers), latent)


class Mixture(NamedTuple):
    """The modes of one item's mixture distribution: the view of its camera, and pictures."""

    own: Float[Tensor, "c h w"]
    """The view of the camera, encoded; the first mode."""
    pictures: Optional[Pictures] = None
    mixing: Optional[Float[Tensor, "c l"]] = None
    """Of the pictures' layers."""
    log_prior: Optional[Float[Tensor, " K"]] = None
    """0 for the modes of the conditional mixture, -inf for others, which belong only to the
    unconditional mixture or to none. Without pictures it is None.
    """


class Modes(NamedTuple):
    """The modes of the items of a batch whose mixtures have the same pictures."""

    own: Float[Tensor, "B d"]
    pictures: Pictures
    mixing: Float[Tensor, "B c l"]

    def squared_distances(
        self, z: Float[Tensor, "B d"], abar: Float[Tensor, " B"]
    ) -> Float[Tensor, "B K"]:
        wide, mixing = z.double(), self.mixing.double()
        of_layers = (mixing.mT @ wide.unflatten(1, (mixing.shape[1], -1))).flatten(1)
        parts = [of_layers @ part.flatten(1).double().mT for part in _chunks(self.pictures.layers)]
        norms = torch.einsum("bcl,klm,bcm->bk", mixing, self.pictures.products, mixing)
        distances = expanded_distances(wide, abar, norms, torch.cat(parts, dim=1))
        return torch.cat([squared_distances(z, self.own[:, None], abar), distances], dim=1)

    def weighted_sum(self, weights: Float[Tensor, "B K"]) -> Float[Tensor, "B d"]:
        layers = weighted_sum(weights[:, 1:], self.pictures.layers.flatten(1))
        found = self.mixing.to(layers) @ layers.unflatten(1, (self.mixing.shape[2], -1))
        return weights[:, :1] * self.own + found.flatten(1)


def modes_of(
    mixtures: list[Mixture],
) -> tuple[Any, Optional[Float[Tensor, "B K"]]]:
    """Return the modes of mixtures with the same pictures, and the logarithms of their priors."""
    own = torch.stack([mixture.own for mixture in mixtures]).flatten(1)
    pictures = mixtures[0].pictures
    if pictures is None:
        return ImageTensor(own[:, None]), None
    mixing = torch.stack([mixture.mixing for mixture in mixtures])
    log_prior = torch.stack([mixture.log_prior for mixture in mixtures])
    return Modes(own, pictures, mixing), log_prior


def mixture_of(
    own: Float[Tensor, "c h w"],
    members: Bool[Tensor, " K"],
    background: Float[Tensor, "bh bw 3"],
    bank: Bank,
    guided: bool,
) -> Mixture:
    """Return a mixture whose conditional modes are the camera's own view and the ``members`` of a
    bank; if it is ``guided``, the whole bank is in its unconditional mixture.

    Args:
        background: what the bank is composited on: one colour (1, 1, 3) or pixels (H', W', 3).
    """
    if background.shape[:2] == (1, 1):
        pictures, mixing = bank.pictures, _mixing_of_color(bank.latent, background)
    else:
        rows = torch.arange(len(members)) if guided else members.nonzero().flatten()
        members = members[rows]
        chunks = rows.to(bank.rgba.device).split(
            images_per_chunk(bank.rgba[0].numel(), rows.device)
        )
        rgba = (bank.rgba.index_select(0, some) for some in chunks)
        latents = [bank.latent.encode(composite(some, background[None])) for some in rgba]
        pictures = Pictures.of(torch.cat(latents))
        mixing = torch.eye(pictures.layers.shape[1], device=background.device)
    conditional = torch.cat([torch.ones(1, dtype=torch.bool), members])
    log_prior = torch.where(conditional, 0.0, -torch.inf).to(background.device)
    return Mixture(own, pictures, mixing, log_prior)


def direction_indices(
    elevation: Float[Tensor, " B"], azimuth: Float[Tensor, " B"]
) -> Int[Tensor, " B"]:
    """Classify views in degrees by threestudio's rules for view-dependent prompts: 0 side, 1 front,
    2 back, 3 overhead.
    """
    indices = torch.zeros_like(azimuth, dtype=torch.long)
    for index, direction in enumerate(view_directions()):
        indices[direction.condition(elevation, azimuth, azimuth)] = index
    return indices


def _mixing_of_color(latent: LinearLatent, color: Float[Tensor, "1 1 3"]) -> Float[Tensor, "c l"]:
    """Return how a colour is added to a picture over black: by its difference to black."""
    color = color.reshape(1, 3, 1, 1)
    tint = (latent.encode_pooled(color) - latent.encode_pooled(torch.zeros_like(color)))[0, :, :, 0]
    return torch.cat([torch.eye(len(tint), device=tint.device), tint], dim=1)


def _chunks(layers: Float[Tensor, "K l h w"]) -> tuple[Float[Tensor, "k l p"], ...]:
    return layers.flatten(2).split(images_per_chunk(layers[:1].numel(), layers.device))
