"""Guidances ``gaussiandreamer-stable-diffusion-guidance`` and ``...-stable-diffusion-xl-guidance``:
score distillation in the latent space of Stable Diffusion.

Takes any model in diffusers' Stable Diffusion format (1.x, 2.x; predicting noise, v or x0).
Options: those of ``guidance/text_to_image.py``."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from ..core.errors import UserError
from ..host import register, register_builtin
from ..models.hub import STABLE_DIFFUSION_XL as XL_FAMILY
from ..models.text_encoders import unpack
from ..prompts.prompt_processors import STABLE_DIFFUSION_XL
from .base import find_bad_items, without_bad_items
from .text_to_image import TextToImageDistillation, resized
from .types import Embeddings, Latents, Timesteps

SIZES = 6
"""How many numbers describe original size, cropped corner and size of a picture."""
PEAK = 64.0
"""Gradients are scaled so that their largest element is in [PEAK, 2 PEAK) when they enter the
backward pass of a half-precision network: float16 has magnitudes from 6e-8 to 65504.
"""


@register_builtin("stable-diffusion-guidance")
@register("gaussiandreamer-stable-diffusion-guidance")
class StableDiffusionGuidance(TextToImageDistillation):
    """Score distillation of renders that the VAE has encoded."""

    components = ("unet", "vae", "scheduler")

    def load(self, folder: Path) -> None:
        from diffusers import AutoencoderKL

        self.vae_dtype = self.vae_type(folder)
        self.vae = self.network(
            AutoencoderKL, folder, "vae", lambda vae: vae.to(self.device), dtype=self.vae_dtype
        )
        self.require_text_to_image(self.vae.config.latent_channels)
        factor = 2 ** (len(self.vae.config.block_out_channels) - 1)
        self.image_size = self.size_of_images(factor)
        factor *= self.denoiser.config.get("patch_size") or 1
        if self.image_size % factor:
            raise UserError(
                f"system.guidance.image_size: expected a multiple of {factor}, got "
                f"{self.image_size}"
            )

    def vae_type(self, folder: Path) -> torch.dtype:
        """Return the number type of the VAE."""
        return self.dtype

    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Latents:
        """Draw float32 latents of unit variance from the VAE, a function of (seed, step, item)."""
        images = resized(rgb, self.image_size) * 2 - 1
        if self.vae_dtype == torch.float32:
            return self._encode(images)
        advice = "set system.guidance.half_precision_weights=false"
        count_bad = partial(self.count_bad, what="the VAE's gradient", advice=advice)
        return with_loss_scales(self._encode, images, count_bad)

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


def with_loss_scales(
    network: Callable[[Tensor], Tensor],
    images: Float[Tensor, "B *d"],
    on_result: Callable[[Bool[Tensor, " B"]], None],
) -> Float[Tensor, "B *e"]:
    """Return ``network(images)`` of a half-precision network with a separate loss scale for each
    item: in the backward pass the gradient of each item is multiplied by a power of two where it
    enters the network, and divided by it in float32 where it leaves.

    Args:
        on_result: called in the backward pass with a mask, (B,) bool, of items whose gradient isn't
            finite; those gradients are set to zero.
    """
    scale = torch.ones(())

    def scaled(grad: Float[Tensor, "B *e"]) -> Float[Tensor, "B *e"]:
        nonlocal scale
        peak = grad.abs().amax(dim=tuple(range(1, grad.dim())), keepdim=True)
        scale = torch.where(peak > 0, PEAK / torch.exp2(peak.log2().floor()), 1.0)
        return grad * scale

    def unscaled(grad: Float[Tensor, "B *d"]) -> Float[Tensor, "B *d"]:
        bad = find_bad_items(grad)
        on_result(bad)
        return without_bad_items(grad, bad) / scale.reshape(-1, *[1] * (grad.dim() - 1))

    if images.requires_grad:
        images.register_hook(unscaled)
    output = network(images)
    if output.requires_grad:
        output.register_hook(scaled)
    return output


@register("gaussiandreamer-stable-diffusion-xl-guidance")
class StableDiffusionXLGuidance(StableDiffusionGuidance):
    """Its UNet is also conditioned on the pooled embedding of the prompt, and on the sizes in
    pixels of the training picture before cropping, of the cropped corner and of the result (Podell
    et al. 2023, section 2.2): here the size that the model sees, (0, 0), and that size again. A VAE
    that overflows in float16 (``force_upcast`` in its settings) stays in float32.
    """

    @dataclass
    class Config(StableDiffusionGuidance.Config):
        pretrained_model_name_or_path: str = STABLE_DIFFUSION_XL

    cfg: Config
    family = XL_FAMILY
    INPUTS = ((None, "text_time"),)

    def vae_type(self, folder: Path) -> torch.dtype:
        from diffusers import AutoencoderKL

        overflows = AutoencoderKL.load_config(folder, subfolder="vae").get("force_upcast", True)
        return torch.float32 if overflows and self.dtype == torch.float16 else self.dtype

    def load(self, folder: Path) -> None:
        super().load(folder)
        config = self.unet.config
        self.pooled_width = (
            config.projection_class_embeddings_input_dim - SIZES * config.addition_time_embed_dim
        )

    def run_network(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, **inputs: Tensor
    ) -> Latents:
        tokens, pooled = unpack(embeddings.to(self.dtype), self.pooled_width)
        side = float(self.image_size)
        sizes = z.new_tensor([side, side, 0, 0, side, side]).expand(len(z), SIZES)
        inputs["added_cond_kwargs"] = {"text_embeds": pooled, "time_ids": sizes}
        return self.unet(z.to(self.dtype), t, encoder_hidden_states=tokens, **inputs).sample
