"""``cfd-variant``: noise that is consistent across views (Yan et al. 2025, Consistent Flow
Distillation, arXiv:2501.05445, eq. 9): noise attached to the rendered surface, the same in all
views and steps.

    e = eps_hat(z_t, t) - eps,   z_t = sqrt(abar) x + sqrt(1 - abar) eps,   eps = noise(surface)

``diffusion/consistent_noise.py`` attaches noise, in place of the paper's eq. 12. The background's
noise is drawn in each step, as in SDS. The paper's t falls in the course of a run: give
``min_step_percent`` and ``max_step_percent`` the same schedule. There are no options."""

from dataclasses import dataclass
from typing import Any, Optional

from jaxtyping import Float
from torch import Tensor

from ...core import streams
from ...core.distributed import first_item
from ...core.errors import UserError
from ...diffusion.consistent_noise import TABLE, attached_noise, cell_values
from ...host import register, run_seed
from ..types import Batch, Latents, Residual
from .base import Variant


@register("cfd-variant")
class CFD(Variant):
    RENDERS = ("depth", "opacity")

    @dataclass
    class Config(Variant.Config):
        REMOVED = {"refresh": (0, "the surface's noise never changes")}

    def configure(self) -> None:
        super().configure()
        self._table: Optional[Float[Tensor, "c TABLE"]] = None

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        if missing := [name for name in self.RENDERS if name not in batch]:
            raise UserError(f"cfd-variant needs the renderer's {' and '.join(missing)}")
        if self._table is None:  # the same in all processes of a run
            generator = streams.generator(run_seed(), "surface noise")
            self._table = cell_values(latents.shape[1], generator).to(latents.device)
        noise = attached_noise(
            latents.shape[-2:],
            self._table,
            streams.derive_seed(run_seed(), "background cells", guidance.step) % TABLE,
            first_item(len(latents)),
            *(batch[name] for name in (*self.RENDERS, "c2w", "fovy")),
        )
        noised = guidance.add_noise(latents, noise)
        return guidance.predict_noise(noised.z, noised.t, condition) - noise, noised.abar
