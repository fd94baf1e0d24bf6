"""``csd-variant``: classifier score distillation (Yu et al. 2023, arXiv:2310.19415, eq. 7): of the
classifier-free guidance only the difference that the prompt makes.

    e = guidance_scale (eps_c(z_t, t) - eps_u(z_t, t))

The paper has no scale; Adam isn't sensitive to it, but ``grad_clip`` is. There are no options."""

from typing import Any

from ...host import register
from ..types import Batch, Latents, Residual
from .base import Variant


@register("csd-variant")
class CSD(Variant):
    NEEDS_UNCONDITIONAL = NEEDS_TEXT = True
    IGNORES = ("guidance_interval", "recon_std_rescale")

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        noised = guidance.add_noise(latents)
        cond, uncond = guidance.both(noised.z, noised.t, condition)
        return guidance.cfg.guidance_scale * (cond - uncond), noised.abar
