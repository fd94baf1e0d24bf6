"""``ism-variant``: interval score matching (Liang et al. 2023, LucidDreamer, arXiv:2311.11284,
section 3.2): the score over one interval of a deterministic trajectory, without random noise. The
trajectory is DDIM inversion, the paper's eq. 9. The gradient is that of eq. 3 of Miao et al. (2024,
Dreamer XL, arXiv:2405.11252), who write the paper's loss in this form.

    z_s = unconditional DDIM inversion of x to s = t - interval
    z_t = one more step of it, from s to t
    e = eps_hat(z_t, t) - eps_u(z_s, s)

eps_u is the prediction for the negative prompt, if there is one; in the paper for the empty prompt.
The interval is 0.05 of the timesteps, and a step of the inversion to s takes 0.2 of them: the
paper's delta_T and delta_S. Its ``guidance_scale`` is 7.5. There are no options."""

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from ...diffusion import sds
from ...diffusion.inversion import Step, invert
from ...host import register
from ..types import Batch, Latents, Residual
from .base import Variant

INTERVAL, STRIDE = 0.05, 0.2


@register("ism-variant")
class ISM(Variant):
    NEEDS_UNCONDITIONAL = True

    @dataclass
    class Config(Variant.Config):
        REMOVED = {"interval": (INTERVAL, "it is 0.05"), "stride": (STRIDE, "it is 0.2")}

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        t, abar = guidance.draw_timesteps(latents)
        count = len(guidance.alphas_cumprod)
        interval, stride = (max(1, round(share * count)) for share in (INTERVAL, STRIDE))
        s = (t - interval).clamp_min(0)

        def predict(step: Step) -> Tensor:
            return guidance.unconditional(step.z, step.t, guidance.select(condition, step.rows))

        z = invert(predict, latents, s, guidance.alphas_cumprod, stride)
        before = guidance.unconditional(z, s, condition)
        z = sds.ddim_step(z, before, guidance.abar_of(s), abar)
        return guidance.predict_noise(z, t, condition) - before, abar
