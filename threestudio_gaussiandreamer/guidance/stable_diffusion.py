"""Guidance ``gaussiandreamer-stable-diffusion-guidance``: score distillation in the latent space of
Stable Diffusion.

Takes any model in diffusers' Stable Diffusion format (1.x, 2.x; predicting noise, v or x0). Options
in addition to those of ``guidance/text_to_image.py``:

===================  ===============================================================================
option               meaning
===================  ===============================================================================
enable_vae_slicing   encode one image at a time, and once more in the backward pass: needs the
                     memory of a single image, and the time of a second encoding
===================  ===============================================================================
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..core.errors import UserError
from ..host import register, register_builtin
from ..prompts.prompt_processors import STABLE_DIFFUSION
from .half_precision import PerItemLossScale
from .text_to_image import TextToImageDistillation, resized
from .types import Latents


@register_builtin("stable-diffusion-guidance")
@register("gaussiandreamer-stable-diffusion-guidance")
class StableDiffusionGuidance(TextToImageDistillation):
    """Score distillation of renders that the VAE has encoded."""

    @dataclass
    class Config(TextToImageDistillation.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION
        enable_vae_slicing: bool = False

        REMOVED: ClassVar[dict[str, Any]] = {
            **TextToImageDistillation.Config.REMOVED,
            "enable_vae_tiling": (False, "images are encoded as a whole"),
        }

    cfg: Config
    components = ("unet", "vae", "scheduler")

    def load(self, folder: Path) -> None:
        from diffusers import AutoencoderKL

        super().load(folder)
        self.vae_dtype = self.vae_type(folder)
        self.vae = self.network(
            AutoencoderKL, folder, "vae", lambda vae: vae.to(self.device), dtype=self.vae_dtype
        )
        self.require_inputs()
        factor = 2 ** (len(self.vae.config.block_out_channels) - 1)
        self.image_size = self.size_of_images(factor)
        factor *= self.patch_size
        if self.image_size % factor:
            raise UserError(
                f"system.guidance.image_size: expected a multiple of {factor}, got "
                f"{self.image_size}"
            )

    def vae_type(self, folder: Path) -> torch.dtype:
        """Return the number type of the VAE."""
        return self.dtype

    def require_inputs(self) -> None:
        """Raise UserError if the model needs inputs that this guidance doesn't have."""
        self.require_text_to_image(self.vae.config.latent_channels)

    @property
    def patch_size(self) -> int:
        """Height and width of the network's patches, latents."""
        return 1

    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Latents:
        """Draw latents from the VAE's posterior, scaled to unit variance, float32. The draw is a
        function of (seed, step, item).
        """
        images = resized(rgb, self.image_size) * 2 - 1
        if self.vae_dtype == torch.float32:
            return self._encode(images)
        loss_scale = PerItemLossScale(self._count_bad_backward)
        return loss_scale.leave(self._encode(loss_scale.enter(images)))

    def _encode(self, images: Float[Tensor, "B 3 s s"]) -> Latents:
        images = images.to(self.vae_dtype)
        if self.cfg.enable_vae_slicing and torch.is_grad_enabled():
            parts = [
                checkpoint(self._moments, image, use_reentrant=False) for image in images.split(1)
            ]
            mean, std = (torch.cat(part) for part in zip(*parts, strict=True))
        else:
            mean, std = self._moments(images)
        latents = mean.float() + std.float() * self.normal(mean, "vae")
        return (latents - self._shift) * self.vae.config.scaling_factor

    @property
    def _shift(self) -> float:
        """The mean of the latents, which models since Stable Diffusion 3 subtract."""
        return getattr(self.vae.config, "shift_factor", None) or 0.0

    def _moments(self, images: Float[Tensor, "B 3 s s"]) -> tuple[Tensor, Tensor]:
        """Return mean and standard deviation of the VAE's posterior, (B, 4, h, w) each."""
        posterior = self.vae.encode(images).latent_dist
        return posterior.mean, posterior.std

    def decode(self, latents: Latents) -> Float[Tensor, "B 3 s s"]:
        latents = (latents / self.vae.config.scaling_factor + self._shift).to(self.vae_dtype)
        # one at a time, since memory matters more than the speed of pictures for display
        images = torch.cat([self.vae.decode(latent).sample for latent in latents.split(1)]).float()
        return (images / 2 + 0.5).clamp(0, 1)

    def _count_bad_backward(self, bad: Bool[Tensor, " B"]) -> None:
        self.count_bad(
            bad, "the VAE's gradient", "set system.guidance.half_precision_weights=false"
        )
