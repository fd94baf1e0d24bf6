"""``sdi-variant``: score distillation via inversion (Lukoianov et al. 2024, arXiv:2405.15891,
eq. 10): noise from DDIM inversion of the render, in place of random noise. It approximates the
fixed point of eq. 8, the noise that the network predicts for the render with this noise.

    z_t = DDIM inversion of x to t with scale inversion_scale
    e = eps_hat(z_t, t) - eps,   eps = (z_t - sqrt(abar) x) / sqrt(1 - abar)

so that with ``weighting_strategy: x0`` the gradient is x minus the denoised z_t, as in threestudio.

===============  ===================================================================================
option           meaning
===============  ===================================================================================
inversion_scale  scale of classifier-free guidance of the inversion; threestudio's -7.5 is -6.5 here
                 without Perp-Neg, and -7.5 with it
inversion_steps  DDIM steps from no noise to all, at most: each is a whole number of timesteps; an
                 inversion to t takes its share of them
eta              0 to 1: share of fresh noise in each step of the inversion; threestudio: 0.3
===============  ===================================================================================

The paper also anneals t linearly (see ``min_step_percent``), and its ``guidance_scale``
is 7.5, which is 8.5 here."""

from dataclasses import dataclass, field
from typing import Any, Optional

from torch import Tensor

from ...core.distributed import first_item
from ...core.options import in_range
from ...diffusion.inversion import NoiseTable, Step, invert
from ...diffusion.sds import per_item
from ...host import register, run_seed
from ..types import Batch, Latents, Residual
from .base import GUIDANCE_SCALE, Variant


@register("sdi-variant")
class SDI(Variant):
    NEEDS_UNCONDITIONAL = True

    @dataclass
    class Config(Variant.Config):
        inversion_scale: float = field(default=-6.5, metadata=GUIDANCE_SCALE)
        inversion_steps: int = field(default=10, metadata=in_range(1, 1000))
        eta: float = field(default=0.3, metadata=in_range(0, 1))

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self._table: Optional[NoiseTable] = None

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        t, abar = guidance.draw_timesteps(latents)
        # rounded up, since each step costs predictions and the option limits their number
        stride = -(-len(guidance.alphas_cumprod) // self.cfg.inversion_steps)
        scale, eta = self.cfg.inversion_scale, self.cfg.eta
        count, first = len(latents), first_item(len(latents))
        if self._table is None or self._table.shape != latents.shape[1:]:
            self._table = NoiseTable(run_seed(), latents.shape[1:], latents.device)

        def predict(step: Step) -> Tensor:
            chosen = guidance.select(condition, step.rows)
            return guidance.guided_noise(step.z, step.t, chosen, scale)

        def fresh(index: int) -> Tensor:
            return self._table.draw("inversion", guidance.step, first, count, part=index)

        z = invert(predict, latents, t, guidance.alphas_cumprod, stride, eta=eta, fresh=fresh)
        noise = z.addcmul(per_item(-abar.sqrt(), z), latents).mul_(per_item((1 - abar).rsqrt(), z))
        return guidance.predict_noise(z, t, condition) - noise, abar
