"""Guidance ``gaussiandreamer-stable-diffusion-3-guidance``: score distillation from a rectified
flow, Stable Diffusion 3 or 3.5 (Esser et al. 2024).

The transformer predicts the velocity v = eps - x of the path z = (1 - sigma) x + sigma eps, which
is converted to the noise of a diffusion with the same ratio of picture and noise
(``diffusion/sds.py``): all options and all variants but VSD apply.
With ``weighting_strategy: rectified_flow`` the gradient is that of RFDS (Yang et al. 2024,
"Text-to-image rectified flow as plug-and-play priors", arXiv 2406.03293, the baseline loss),

    grad = v_hat(z, sigma) - (eps - x) = (eps_hat - eps) / (1 - sigma).

Timestep t of 1000 is sigma = shift u / (1 + (shift - 1) u), u = t / 1000. Options in addition to
those of ``guidance/stable_diffusion.py``:

==================  ================================================================================
option              meaning
==================  ================================================================================
flow_shift          ``shift``; none = that of the model's scheduler, 3
weighting_strategy  rectified_flow unless given
==================  ================================================================================
"""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..core.options import in_range, one_of
from ..diffusion import sds
from ..host import register
from ..models.hub import STABLE_DIFFUSION_3 as FAMILY
from ..models.model_files import load_settings
from ..models.text_encoders import unpack
from ..prompts.prompt_processors import STABLE_DIFFUSION_3
from .stable_diffusion import StableDiffusionGuidance
from .types import Embeddings, Latents, Timesteps


@register("gaussiandreamer-stable-diffusion-3-guidance")
class StableDiffusion3Guidance(StableDiffusionGuidance):
    @dataclass
    class Config(StableDiffusionGuidance.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION_3
        weighting_strategy: str = field(default="rectified_flow", metadata=one_of(sds.WEIGHTS))
        flow_shift: Optional[float] = field(default=None, metadata=in_range(0.01, 100))

    cfg: Config
    components = ("transformer", "vae", "scheduler")
    family = FAMILY
    NO_LORA = "Stable Diffusion 3 is a transformer"

    @property
    def denoiser(self) -> Any:
        return self.transformer

    def set_schedule(self, folder: Path) -> None:
        """Read the shift and the number of the timesteps of the model's training."""
        from diffusers import FlowMatchEulerDiscreteScheduler

        config = load_settings(FlowMatchEulerDiscreteScheduler, folder, "scheduler").config
        if config.use_dynamic_shifting and self.cfg.flow_shift is None:
            raise UserError(
                f"the scheduler of {self.cfg.pretrained_model_name_or_path} chooses its shift by "
                "the size of the picture: set system.guidance.flow_shift, such as 3"
            )
        self.prediction_type = "velocity"
        shift = config.shift if self.cfg.flow_shift is None else self.cfg.flow_shift
        sigmas = sds.shifted_sigmas(config.num_train_timesteps, shift)
        self.set_alphas_cumprod(sds.abar_of_sigma(sigmas))

    def load_denoiser(self, folder: Path) -> None:
        from diffusers import SD3Transformer2DModel

        self.transformer = self.network(
            SD3Transformer2DModel, folder, "transformer", self.prepare_denoiser
        )
        self.text_width = self.transformer.config.joint_attention_dim

    def size_of_images(self, factor: int = 1) -> int:
        size, config = super().size_of_images(factor), self.transformer.config
        largest = config.pos_embed_max_size * config.patch_size * factor
        if size > largest:
            raise UserError(
                f"system.guidance.image_size: {self.cfg.pretrained_model_name_or_path} knows "
                f"positions up to {largest} pixels, got {size}"
            )
        return size

    def run_network(self, z: Latents, t: Timesteps, embeddings: Embeddings) -> Latents:
        abar = self._abar[t]
        sigma = sds.sigma_of_abar(abar)
        width = self.transformer.config.pooled_projection_dim
        tokens, pooled = unpack(embeddings.to(self.dtype), width)
        return self.transformer(
            hidden_states=sds.on_path(z, abar).to(self.dtype),
            timestep=(sigma * len(self.alphas_cumprod)).float(),
            encoder_hidden_states=tokens,
            pooled_projections=pooled,
        ).sample
