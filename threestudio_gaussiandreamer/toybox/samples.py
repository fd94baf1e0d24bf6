"""Draw pictures with the 2D model itself, from the directions of some views.

They show what the score distillation is guided towards, without a contrast of views.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import Orbit
from ..core.streams import generator
from ..diffusion import sds
from ..host import find

STEPS = 25
PROMPTS = "gaussiandreamer-stable-diffusion-prompt-processor"
GUIDANCE = "gaussiandreamer-stable-diffusion-guidance"


@torch.no_grad()
def samples(
    model: str, prompt: str, orbit: Orbit, *, guidance_scale: float, seed: int = 0
) -> Float[Tensor, "V 3 s s"]:
    """Draw a picture in [0, 1] for the direction of each view by DDIM; prompts name left and right.

    Args:
        model: ``toybox``, a folder or a hub id.
        guidance_scale: of classifier-free guidance; 1 is none.
        seed: of the noise.
    """
    named = {"pretrained_model_name_or_path": model}
    prompts = find(PROMPTS)(
        {
            **named,
            "prompt": prompt,
            "negative_prompt": "",
            "view_dependent_left_and_right": True,
            "use_cache": False,
        }
    )
    guidance = find(GUIDANCE)({**named, "guidance_scale": guidance_scale})
    condition = guidance.condition(
        prompts(), elevation=orbit.elevation, azimuth=orbit.azimuth, camera_distances=orbit.distance
    )
    side = guidance.image_size // 2 ** (len(guidance.vae.config.block_out_channels) - 1)
    shape = (len(orbit.azimuth), guidance.vae.config.latent_channels, side, side)
    noise = torch.randn(shape, generator=generator(seed, "toybox-samples")).to(guidance.device)
    abar = guidance.alphas_cumprod.to(guidance.device)
    t = torch.full((len(noise),), len(abar) - 1, device=guidance.device)
    latents = sds.ddim_sample(
        lambda z, t: guidance.predict_noise(z, t, condition), noise, t, abar, steps=STEPS
    )
    return guidance.decode(latents).cpu()
