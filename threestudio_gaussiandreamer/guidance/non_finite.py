"""Items of a batch whose gradient isn't finite: they are found and left out of the loss."""

import torch
from jaxtyping import Bool
from torch import Tensor

from ..diffusion import sds


def find_bad_items(grad: Tensor) -> Tensor:
    """Return which items contain NaN or infinity, (B,) bool. If the sum over all elements is finite
    then so are the elements, so on a CPU the usual case needs a single reduction.
    """
    if not grad.is_cuda and grad.sum().isfinite():
        return torch.zeros(len(grad), dtype=torch.bool, device=grad.device)
    return ~torch.isfinite(grad).flatten(1).all(dim=1)


def may_have_any(bad: Bool[Tensor, " B"]) -> bool:
    """Return whether any item is bad; true on a GPU, where looking would wait for the score."""
    return bad.is_cuda or bool(bad.any())


def without_bad_items(values: Tensor, bad: Bool[Tensor, " B"]) -> Tensor:
    """Return the values, (B, ...), with those of bad items set to zero."""
    return values.masked_fill(bad.reshape(-1, *[1] * (values.dim() - 1)), 0.0)


def masked_loss(images: Tensor, latents: Tensor, grad: Tensor, bad: Tensor) -> Tensor:
    """Compute the loss without the bad items. Their ``grad`` is zero, and the gradients of their
    renders are set to exactly zero.
    """
    if images.requires_grad and may_have_any(bad):
        # If the encoder's derivative is infinite, the product with a zero gradient is NaN.
        images.register_hook(lambda gradient: without_bad_items(gradient, bad))
    return sds.sds_loss(latents, grad)
