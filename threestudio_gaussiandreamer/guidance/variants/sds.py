"""``sds-variant``: score distillation sampling (Poole et al. 2022, DreamFusion, eq. 3).

    e = eps_hat(z_t, t) - eps

This is the default; it has no options. Clipping (``grad_clip``) and rescaling
(``recon_std_rescale``) are options of the guidance; the latter has no effect on the CSD and NFSD
variants."""

from typing import Any

from jaxtyping import Float
from torch import Tensor

from ...host import register
from .base import Batch, Error, Variant


@register("sds-variant")
class SDS(Variant):
    def error(
        self, guidance: Any, latents: Float[Tensor, "B c h w"], condition: Any, batch: Batch
    ) -> Error:
        known = guidance.known_error(latents, condition)
        if known is not None:
            return known
        noised = guidance.add_noise(latents)
        eps = guidance.predict_noise(noised.z, noised.t, condition)
        return eps - noised.noise, noised.abar
