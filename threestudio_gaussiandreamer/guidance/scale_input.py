"""The guidance scale as an input of a UNet (Meng et al. 2023, "On Distillation of Guided Diffusion
Models", arXiv:2210.03142), such as that of a latent consistency model (Luo et al. 2023,
arXiv:2310.04378). The UNet predicts the noise with guidance in one evaluation instead of two.

In diffusers' format these have ``time_cond_proj_dim``, the width of the scale's embedding. Other
models predict the mean of all pictures that fit z; a consistency model predicts one of them.
"""

from typing import Any, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..host import warn

UNIT = 1000.0
"""Factor of w in its embedding."""
USUAL = (1.0, 20.0)
"""Scales that such models may know; the latent consistency models' are 3 to 15."""


def scale_input(
    scale: float, width: Optional[int], count: int, **options: Any
) -> dict[str, Float[Tensor, "B width"]]:
    """Return the input of a UNet that tells it the scale.

    Args:
        scale: 1 for no guidance; the embedded w is one less.
        width: of the embedding; None if the UNet doesn't take the scale.
        count: number of latents, B.
        options: device and type of the result.
    """
    if width is None:
        return {}
    from diffusers.models.embeddings import get_timestep_embedding

    w = torch.full((count,), scale - 1.0)
    embedding = get_timestep_embedding(UNIT * w, width, downscale_freq_shift=1)
    return {"timestep_cond": embedding.to(**options)}


def scale_width(unet: Any, cfg: Any) -> Optional[int]:
    """Return the width of the scale's embedding, None if ``unet`` doesn't take the scale; warn of a
    scale that hardly any model was trained with.

    Args:
        cfg: the options of the guidance.
    """
    width = unet.config.time_cond_proj_dim
    if width is not None and not USUAL[0] <= cfg.guidance_scale <= USUAL[1]:
        warn(
            f"{cfg.pretrained_model_name_or_path} takes the guidance scale as an input, and was "
            f"trained for some only: system.guidance.guidance_scale={cfg.guidance_scale:g} is "
            "hardly one of them (see its model card; latent consistency models know 3 to 15)"
        )
    return width
