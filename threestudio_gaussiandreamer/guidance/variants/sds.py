"""``sds-variant``: score distillation sampling (Poole et al. 2022, DreamFusion, eq. 3).

    e = eps_hat(z_t, t) - eps

This is the default; it has no options."""

from typing import Any

from ...host import register
from ..types import Batch, Latents, Residual
from .base import Variant


@register("sds-variant")
class SDS(Variant):
    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        known = guidance.known_residual(latents, condition)
        if known is not None:
            return known
        noised = guidance.add_noise(latents)
        eps = guidance.predict_noise(noised.z, noised.t, condition)
        return eps - noised.noise, noised.abar
