"""``csd-variant``: classifier score distillation (Yu et al. 2023, arXiv:2310.19415, eq. 7): of the
classifier-free guidance only the difference that the prompt makes.

    e = guidance_scale (eps_c(z_t, t) - eps_u(z_t, t))

The paper has no scale; Adam isn't sensitive to it, but ``grad_clip`` is, and with it the error is
what SDS at the same scale adds to eps_u - eps. There are no options."""

from typing import Any

from ...core.errors import UserError
from ...host import register
from ..types import Batch, Latents, Residual
from .base import Variant


@register("csd-variant")
class CSD(Variant):
    NEEDS_UNCONDITIONAL = NEEDS_TEXT = True
    IGNORES = ("guidance_interval", "recon_std_rescale")

    @classmethod
    def preflight(cls, guidance: type, cfg: Any) -> None:
        super().preflight(guidance, cfg)
        if cfg.guidance_scale == 0:
            raise UserError(
                f"system.guidance.guidance_scale: {cfg.variant_type} is multiplied by it, so its "
                "gradient is zero with 0: set it to another number"
            )

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        noised = guidance.add_noise(latents)
        cond, uncond = guidance.both(noised.z, noised.t, condition)
        return guidance.cfg.guidance_scale * (cond - uncond), noised.abar
