"""Guidance ``gaussiandreamer-deep-floyd-guidance``: score distillation in the pixels of DeepFloyd
IF's first stage, 64 x 64.

Options: those of ``guidance/text_to_image.py``; ``guidance_scale`` is 20 by default."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..host import register, register_builtin
from ..models.hub import DEEP_FLOYD as FAMILY
from ..prompts.prompt_processors import DEEP_FLOYD
from .base import GUIDANCE_SCALE
from .text_to_image import TextToImageDistillation, resized


@register_builtin("deep-floyd-guidance")
@register("gaussiandreamer-deep-floyd-guidance")
class DeepFloydGuidance(TextToImageDistillation):
    @dataclass
    class Config(TextToImageDistillation.Config):
        pretrained_model_name_or_path: str = DEEP_FLOYD
        guidance_scale: float = field(default=20.0, metadata=GUIDANCE_SCALE)

    cfg: Config
    family = FAMILY

    def load(self, folder: Path) -> None:
        self.require_text_to_image(3)
        self.image_size = self.size_of_images()

    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Float[Tensor, "B 3 s s"]:
        """Return the pixels themselves, in [-1, 1]."""
        return resized(rgb, self.image_size) * 2 - 1

    def decode(self, latents: Float[Tensor, "B 3 s s"]) -> Float[Tensor, "B 3 s s"]:
        return (latents / 2 + 0.5).clamp(0, 1)
