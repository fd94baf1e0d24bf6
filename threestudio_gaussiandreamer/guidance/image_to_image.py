"""Image to image (SDEdit, Meng et al. 2022, arXiv:2108.01073): add noise to pictures, and denoise
them in several steps.
"""

from typing import TYPE_CHECKING, Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.devices import without_autocast
from ..diffusion import sds

if TYPE_CHECKING:
    from .base import ScoreDistillation


@torch.no_grad()
def image_to_image(
    guidance: "ScoreDistillation",
    rgb: Float[Tensor, "B H W 3"],
    prompt_utils: Any,
    *,
    strength: float,
    num_inference_steps: int,
    guidance_scale: float,
    **batch: Any,
) -> Float[Tensor, "B h w 3"]:
    """Draw pictures of the prompt that resemble ``rgb``, of the model's size.

    Args:
        rgb: pictures in [0, 1].
        strength: the timestep that they are noised to, as a share of all; 1 leaves nothing of them.
        num_inference_steps: of DDIM, from that timestep to no noise; at most one per timestep.
        guidance_scale: of classifier-free guidance; without effect if the guidance's own is 1, as
            it has no unconditional prediction then, unless the network takes the scale.
        batch: the cameras, and what else ``encode`` and ``condition`` need.
    """
    with without_autocast(rgb.device.type):
        latents = guidance.encode(rgb.float().movedim(-1, 1).contiguous(), **batch).float()
        condition = guidance.condition(prompt_utils, **batch)
        start = round(strength * (len(guidance.alphas_cumprod) - 1))
        t = torch.full((len(latents),), start, device=rgb.device)
        z = sds.add_noise(latents, guidance.normal(latents, "image to image"), guidance.abar_of(t))
        denoised = sds.ddim_sample(
            lambda z, t: guidance.guided_noise(z, t, condition, guidance_scale),
            z,
            t,
            guidance.alphas_cumprod.to(z.device),
            steps=max(1, min(num_inference_steps, start)),
        )
        return guidance.decode(denoised).float().movedim(1, -1)
