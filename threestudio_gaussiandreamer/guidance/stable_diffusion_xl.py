"""Guidance ``gaussiandreamer-stable-diffusion-xl-guidance``: score distillation in the latent space
of Stable Diffusion XL (Podell et al. 2023).

Options: those of ``guidance/stable_diffusion.py``. The base model is taken, not the refiner. Its
UNet is also conditioned on the pooled embedding of the prompt, and on the sizes in pixels of the
training picture before cropping, of the cropped corner and of the result (section 2.2): here the
size that the model sees, (0, 0), and that size again.

The published VAE overflows in float16 (``force_upcast`` in its settings): with float16 weights it
stays in float32, unless it is one that was mended for half precision."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor

from ..core.errors import UserError
from ..host import register
from ..models.families import STABLE_DIFFUSION_XL as FAMILY
from ..models.model_files import pipeline_settings
from ..models.text_encoders import unpack
from ..prompts.prompt_processors import STABLE_DIFFUSION_XL
from .stable_diffusion import StableDiffusionGuidance
from .types import Embeddings, Latents, Timesteps

SIZES = 6
"""How many numbers describe original size, cropped corner and size of a picture."""


@register("gaussiandreamer-stable-diffusion-xl-guidance")
class StableDiffusionXLGuidance(StableDiffusionGuidance):
    @dataclass
    class Config(StableDiffusionGuidance.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION_XL

    cfg: Config
    family = FAMILY

    def vae_type(self, folder: Path) -> torch.dtype:
        from diffusers import AutoencoderKL

        overflows = AutoencoderKL.load_config(folder, subfolder="vae").get("force_upcast", True)
        return torch.float32 if overflows and self.dtype == torch.float16 else self.dtype

    def load(self, folder: Path) -> None:
        if pipeline_settings(folder).get("requires_aesthetics_score"):
            raise UserError(
                f"{self.cfg.pretrained_model_name_or_path} is Stable Diffusion XL's refiner, which "
                "only finishes pictures: use the base model"
            )
        super().load(folder)
        config = self.unet.config
        self.pooled_width = (
            config.projection_class_embeddings_input_dim - SIZES * config.addition_time_embed_dim
        )

    def require_inputs(self) -> None:
        self.require_text_to_image(self.vae.config.latent_channels, ("text_time",))

    def run_network(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, **inputs: Tensor
    ) -> Latents:
        tokens, pooled = unpack(embeddings.to(self.dtype), self.pooled_width)
        side = float(self.image_size)
        sizes = z.new_tensor([side, side, 0, 0, side, side]).expand(len(z), SIZES)
        inputs["added_cond_kwargs"] = {"text_embeds": pooled, "time_ids": sizes}
        return self.unet(z.to(self.dtype), t, encoder_hidden_states=tokens, **inputs).sample
