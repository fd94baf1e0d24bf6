"""Pictures of a mesh: those of a batch's cameras, the ground truth, and a bank of views around it,
the modes of the exact score's mixtures.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, UInt8
from torch import Tensor

from ..diffusion.exact_score import (
    LinearLatent,
    denoise,
    expanded_distances,
    images_per_chunk,
    squared_distances,
    weighted_sum,
)
from ..meshes.raycast import MeshCaster, TargetCache

Size = tuple[int, int]
"""Height and width, pixels."""


class MeshTruth:
    """Ray casts a mesh, and caches the pictures of recent cameras.

    Args:
        mesh: casts rays at the mesh.
        supersample: rays per pixel and axis.
        max_cached: largest number of cached pictures, which are stored as uint8.
        prefetch_size: maps a render's size to that of the picture that training needs for it.
    """

    def __init__(
        self,
        mesh: MeshCaster,
        supersample: int,
        max_cached: int,
        prefetch_size: Callable[[int, int], Size],
    ) -> None:
        self.mesh, self._prefetch_size = mesh, prefetch_size
        self.pictures = TargetCache(mesh, supersample, max_cached)

    @torch.no_grad()
    def render(
        self,
        batch: dict[str, Any],
        background: Optional[Tensor] = None,
        *,
        size: Optional[Size] = None,
    ) -> Float[Tensor, "B H W 3"]:
        """Render the ground truth from the views of a batch.

        Args:
            batch: has ``c2w``, ``fovy``, ``height`` and ``width``.
            background: (B, 1, 1, 3) or (B, H, W, 3); None for black.
            size: (height, width) of the pictures, pixels; None for the batch's size.
        """
        height, width = size or (batch["height"], batch["width"])
        rgba = self.pictures(batch["c2w"], batch["fovy"], height, width)
        background = background_of(background, len(rgba), rgba.device)
        return composite(rgba, background).movedim(1, -1)

    @torch.no_grad()
    def prefetch(
        self, c2w: Float[Tensor, "V 4 4"], fovy: Float[Tensor, " V"], height: int, width: int
    ) -> None:
        """Plan to cast these views, most of which training will need, in large batches, if all fit
        into the cache.
        """
        if len(c2w) <= self.pictures.capacity:
            self.pictures.plan(c2w, fovy, *self._prefetch_size(height, width))


def background_of(
    background: Optional[Tensor], batch: int, device: torch.device
) -> Float[Tensor, "B bh bw 3"]:
    """Return the background of the renders, detached, or black if it is None."""
    if background is None:
        return torch.zeros(batch, 1, 1, 3, device=device)
    return background.detach().float().expand(batch, -1, -1, -1)


def composite(
    rgba: UInt8[Tensor, "B H W 4"], background: Float[Tensor, "#B bh bw 3"]
) -> Float[Tensor, "B 3 H W"]:
    """Composite premultiplied pictures over the background, which is resized to their size."""
    background = background.movedim(-1, 1)
    if background.shape[-2:] != (1, 1):
        background = resized(background, tuple(rgba.shape[1:3]))
    rgba = rgba.movedim(-1, 1).contiguous().to(background).div_(255)
    return ((1 - rgba[:, 3:]) * background).add_(rgba[:, :3])


def resized(images: Float[Tensor, "B c H W"], size: tuple[int, int]) -> Float[Tensor, "B c h w"]:
    """Resize images: average blocks if the sizes divide evenly, else bilinear with antialiasing."""
    height, width = images.shape[-2:]
    if (height, width) == size:
        return images
    if height % size[0] == 0 and width % size[1] == 0:
        return F.avg_pool2d(images, (height // size[0], width // size[1]))
    return F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=True)


class Pictures(NamedTuple):
    """Encoded pictures, each a linear combination of its layers: channel c of picture k is
    ``sum_l mixing[c, l] layers[k, l]``. Over a colour, the layers are the picture over black and
    the share of the colour in each pixel: a bank needn't be composited on the colour of each item.
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
    """0 for the modes of the conditional mixture, -inf for others."""


def scores(
    z: Float[Tensor, "B d"], abar: Float[Tensor, " B"], mixtures: list[Mixture]
) -> tuple[Float[Tensor, "B d"], Float[Tensor, " B"], Callable[[], Float[Tensor, "B d"]]]:
    """Return the conditional prediction of the noise in z, the perplexity of its responsibilities,
    and what computes the unconditional prediction, for mixtures that have the same pictures.
    """
    own = torch.stack([mixture.own for mixture in mixtures]).flatten(1)
    pictures = mixtures[0].pictures
    if pictures is None:  # the responsibility of a single mode is 1 at any distance
        distances = z.new_zeros((len(z), 1), dtype=torch.float64)
        mean_of, log_prior = own.mul, None
    else:
        mixing = torch.stack([mixture.mixing for mixture in mixtures])
        log_prior = torch.stack([mixture.log_prior for mixture in mixtures])
        wide, double = z.double(), mixing.double()
        of_layers = (double.mT @ wide.unflatten(1, (mixing.shape[1], -1))).flatten(1)
        parts = [of_layers @ part.flatten(1).double().mT for part in _chunks(pictures.layers)]
        norms = torch.einsum("bcl,klm,bcm->bk", double, pictures.products, double)
        of_pictures = expanded_distances(wide, abar, norms, torch.cat(parts, dim=1))
        distances = torch.cat([squared_distances(z, own[:, None], abar), of_pictures], dim=1)

        def mean_of(weights: Float[Tensor, "B K"]) -> Float[Tensor, "B d"]:
            layers = weighted_sum(weights[:, 1:], pictures.layers.flatten(1))
            found = mixing.to(layers) @ layers.unflatten(1, (mixing.shape[2], -1))
            return weights[:, :1] * own + found.flatten(1)

    eps, perplexity = denoise(z, abar, distances, mean_of, log_prior)
    return eps, perplexity, lambda: denoise(z, abar, distances, mean_of)[0]


def mixture_of(
    own: Float[Tensor, "c h w"],
    members: Bool[Tensor, " K"],
    background: Float[Tensor, "bh bw 3"],
    bank: Bank,
    whole: bool,
) -> Mixture:
    """Return a mixture whose conditional modes are the camera's own view and the ``members`` of a
    bank.

    Args:
        background: what the bank is composited on: one colour (1, 1, 3) or pixels (H', W', 3).
        whole: whether the unconditional mixture, the whole bank, is needed too.
    """
    if background.shape[:2] == (1, 1):
        pictures, mixing = bank.pictures, _mixing_of_color(bank.latent, background)
    else:
        rows = torch.arange(len(members)) if whole else members.nonzero().flatten()
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


def _mixing_of_color(latent: LinearLatent, color: Float[Tensor, "1 1 3"]) -> Float[Tensor, "c l"]:
    """Return how a colour is added to a picture over black: by its difference to black."""
    color = color.reshape(1, 3, 1, 1)
    tint = (latent.encode_pooled(color) - latent.encode_pooled(torch.zeros_like(color)))[0, :, :, 0]
    return torch.cat([torch.eye(len(tint), device=tint.device), tint], dim=1)


def _chunks(layers: Float[Tensor, "K l h w"]) -> tuple[Float[Tensor, "k l p"], ...]:
    return layers.flatten(2).split(images_per_chunk(layers[:1].numel(), layers.device))
