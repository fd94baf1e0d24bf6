"""The guidance scale as an input of a UNet (Meng et al. 2023, "On Distillation of Guided Diffusion
Models", arXiv:2210.03142), such as that of a latent consistency model (Luo et al. 2023,
arXiv:2310.04378). The UNet predicts the noise with guidance in one evaluation instead of two.

In diffusers' format these have ``time_cond_proj_dim``, the width of the scale's embedding. A
consistency model predicts a picture, not the mean of all pictures that fit z, as others do.
"""

from typing import Optional

import torch
from jaxtyping import Float
from torch import Tensor

UNIT = 1000.0
"""Factor of w in its embedding."""


def scale_input(
    scale: float, width: Optional[int], z: Float[Tensor, "B c h w"]
) -> dict[str, Float[Tensor, "B width"]]:
    """Return the input of a UNet that tells it the scale.

    Args:
        scale: 1 for no guidance; the embedded w is one less.
        width: of the embedding; None if the UNet doesn't take the scale.
        z: the latents; one row is returned for each, of their type and on their device.
    """
    if width is None:
        return {}
    from diffusers.models.embeddings import get_timestep_embedding

    w = torch.full((len(z),), scale - 1, device=z.device)
    embedding = get_timestep_embedding(UNIT * w, width, downscale_freq_shift=1)
    return {"timestep_cond": embedding.to(z)}
