"""``mock-guidance``: for tests of a pipeline; needs neither weights nor a mesh.

The exact score, eps_hat = (z - sqrt(abar) y) / sqrt(1 - abar), of one picture y for each view: a
disc in a colour that the prompt gives, in front of the render's background. It takes the options of
``guidance/base.py``, every variant and any prompt processor.

=============================  ===================================================================
option                         meaning
=============================  ===================================================================
pretrained_model_name_or_path  isn't read: prompt processors of configurations for diffusion models
                               refer to it
=============================  ===================================================================
"""

import hashlib
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..diffusion import sds
from ..host import register
from .base import ScoreDistillation

RADIUS = 0.6
"""Of the disc, in units of half the picture's side."""
UNCONDITIONAL = 0.99
"""Contrast of the picture without a prompt: near 1, since guidance scales may be 100."""


def prompt_color(prompt: str) -> list[float]:
    """Return a colour that is a function of the text, each channel in [0.2, 0.9]."""
    digest = hashlib.sha256(prompt.encode(errors="replace")).digest()
    return [0.2 + 0.7 * byte / 255 for byte in digest[:3]]


@register("mock-guidance")
class MockGuidance(ScoreDistillation):
    @dataclass
    class Config(ScoreDistillation.Config):
        pretrained_model_name_or_path: str = ""

    cfg: Config

    def encode(self, rgb: Float[Tensor, "B 3 H W"], **batch: Any) -> Float[Tensor, "B 3 H W"]:
        return 2 * rgb - 1

    def decode(self, latents: Float[Tensor, "B 3 H W"]) -> Float[Tensor, "B 3 H W"]:
        return (latents + 1) / 2

    def condition(self, prompt_utils: Any, **batch: Any) -> Float[Tensor, "B 3 H W"]:
        """Return the picture of each view, in [-1, 1]."""
        height, width = int(batch["height"]), int(batch["width"])
        azimuth = batch["azimuth"]
        y = torch.linspace(1, -1, height, device=azimuth.device).reshape(-1, 1)
        x = torch.linspace(-1, 1, width, device=azimuth.device)
        cover = torch.sigmoid(10 * (RADIUS - torch.hypot(x, y)))[..., None]
        color = torch.tensor(prompt_color(str(getattr(prompt_utils, "prompt", ""))))
        shade = 0.8 + 0.2 * y[..., None]
        behind = batch.get("comp_rgb_bg", torch.full((1, 1, 1, 3), 0.5)).detach()
        picture = cover * shade * color.to(x) + (1 - cover) * behind.to(x)
        return (2 * picture.expand(len(azimuth), height, width, 3) - 1).movedim(-1, 1)

    def predict(
        self, z: Float[Tensor, "B 3 H W"], t: Tensor, condition: Float[Tensor, "B 3 H W"]
    ) -> tuple[Tensor, Tensor]:
        self.evaluations += len(z)
        abar = sds.per_item(self.abar_of(t), z)
        return tuple(
            (z - abar.sqrt() * share * condition) / (1 - abar).sqrt()
            for share in (1.0, UNCONDITIONAL)
        )
