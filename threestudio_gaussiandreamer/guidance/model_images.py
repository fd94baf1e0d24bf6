"""The images that a text-to-image model gets: their size, and renders resized to it."""

from functools import lru_cache
from typing import Any

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..host import warn

ENLARGED = 4
"""Renders that are enlarged by a larger factor are worth a warning."""


def size_of_images(cfg: Any, trained: Any, factor: int) -> int:
    """Return height and width of the images for the model, pixels: ``cfg.image_size``, or
    ``factor`` times the latent size that the model was trained with. Warn if they differ.

    Args:
        trained: ``sample_size`` of the model's configuration.

    Raises:
        UserError: neither is known.
    """
    if not isinstance(trained, int):
        if cfg.image_size is None:
            raise UserError(
                f"{cfg.pretrained_model_name_or_path} has sample_size {trained}: set "
                "system.guidance.image_size, pixels"
            )
        return cfg.image_size
    size = trained * factor
    if cfg.image_size not in (None, size):
        warn(
            f"system.guidance.image_size={cfg.image_size}: {cfg.pretrained_model_name_or_path} was "
            f"trained on images of {size} x {size} and may draw poor ones of another size"
        )
    return cfg.image_size or size


def resized(images: Float[Tensor, "B 3 H W"], size: int) -> Float[Tensor, "B 3 s s"]:
    """Resize images to the model's size, with antialiasing if they shrink by more than a factor of
    2, since bilinear sampling would skip pixels.
    """
    height, width = images.shape[-2:]
    if (height, width) == (size, size):
        return images
    warn_of_small_renders(height, width, size)
    antialias = max(height, width) > 2 * size
    return F.interpolate(
        images, (size, size), mode="bilinear", align_corners=False, antialias=antialias
    )


@lru_cache
def warn_of_small_renders(height: int, width: int, size: int) -> None:
    """Warn, once per process, of renders that the model gets blurred."""
    if min(height, width) * ENLARGED < size:
        warn(
            f"renders of {width} x {height} are enlarged to the {size} x {size} of the model, "
            "which sees them blurred: give a larger data.width and data.height"
        )
