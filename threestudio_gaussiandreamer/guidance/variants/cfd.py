"""``cfd-variant``: noise that is consistent across views (Yan et al. 2025, Consistent Flow
Distillation, arXiv:2501.05445, eq. 9): noise attached to the rendered surface, the same in all
views and steps.

    e = eps_hat(z_t, t) - eps,   z_t = sqrt(abar) x + sqrt(1 - abar) eps,   eps = noise(surface)

``diffusion/consistent_noise.py`` attaches noise, in place of the paper's eq. 12. The background's
noise is drawn in each step, as in SDS. The paper's t falls in the course of a run: use
``timestep_schedule: linear`` with it.

=======  ===========================================================================================
option   meaning
=======  ===========================================================================================
refresh  steps after which the surface gets new noise; 0: never, the paper's deterministic flow
=======  ===========================================================================================
"""

from dataclasses import dataclass, field
from typing import Any, Optional

from jaxtyping import Float
from torch import Tensor

from ...core import streams
from ...core.distributed import first_item
from ...core.errors import UserError
from ...core.options import at_least
from ...diffusion.consistent_noise import TABLE, attached_noise, cell_values
from ...host import register, run_seed
from .base import Batch, Error, Variant


@register("cfd-variant")
class CFD(Variant):
    RENDERS = ("depth", "opacity")

    @dataclass
    class Config(Variant.Config):
        refresh: int = field(default=0, metadata=at_least(0, "steps"))

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self._table: Optional[tuple[int, Tensor]] = None

    def error(
        self, guidance: Any, latents: Float[Tensor, "B c h w"], condition: Any, batch: Batch
    ) -> Error:
        if missing := [name for name in self.RENDERS if name not in batch]:
            raise UserError(
                f"cfd-variant attaches noise to the rendered surface: give the guidance the "
                f"renderer's {' and '.join(missing)}, as gaussiandreamer-system does"
            )
        noise = attached_noise(
            latents.shape[-2:],
            self.table(guidance.step, latents),
            streams.derive_seed(run_seed(), "background cells", guidance.step) % TABLE,
            first_item(len(latents)),
            *(batch[name] for name in (*self.RENDERS, "c2w", "fovy")),
        )
        noised = guidance.noised(latents, noise)
        return guidance.predict_noise(noised.z, noised.t, condition) - noise, noised.abar

    def table(self, step: int, latents: Float[Tensor, "B c h w"]) -> Float[Tensor, "c TABLE"]:
        """Return the values of the cells, the same in all processes of a run."""
        epoch = step // self.options.refresh if self.options.refresh else 0
        if self._table is None or self._table[0] != epoch:
            generator = streams.generator(run_seed(), "surface noise", epoch)
            values = cell_values(latents.shape[1], generator)
            self._table = epoch, values.to(latents.device)
        return self._table[1]
