"""``vsd-variant``: variational score distillation (Wang et al. 2023, ProlificDreamer, eq. 9).

    e = eps_hat(z_t, t) - eps_particles(z_t, t, camera)

eps_particles predicts the noise in the renders' own distribution; it is trained beside the cloud to
minimise E |eps_particles(z_t, t, camera) - eps|^2 on the renders (eq. 8). For text-to-image models
it is the UNet with a LoRA in its attention (``guidance/lora.py``). For a score in closed form it is
the optimal denoiser of a Gaussian with the renders' running mean and variance, of all cameras
together (``guidance/particles.py``): a perfect model of a single cloud's renders would give SDS,
from which VSD differs by what the particle model cannot represent.

==============  ====================================================================================
option          meaning
==============  ====================================================================================
rank            rank of the LoRA
lr              learning rate of the LoRA
samples         noisy renders per render and step that the LoRA is trained on
camera_dropout  share of the LoRA's training without the camera
momentum        of a score in closed form: share of the running averages that a step keeps
==============  ====================================================================================

ProlificDreamer's ``guidance_scale`` is 7.5."""

from dataclasses import dataclass, field
from typing import Any, Optional

from jaxtyping import Bool, Float
from torch import Tensor

from ...core.options import in_range, positive, require_defaults
from ...host import parse_structured, register
from ..particles import ParticleModel, Renders
from ..score_pictures import items_of
from .base import Batch, Error, Variant


@register("vsd-variant")
class VSD(Variant):
    @dataclass
    class Config(Variant.Config):
        rank: int = field(default=4, metadata=in_range(1, 1024))
        lr: float = field(default=1e-4, metadata=positive())
        samples: int = field(default=1, metadata=in_range(1, 64))
        camera_dropout: float = field(default=0.1, metadata=in_range(0, 1))
        momentum: float = field(default=0.95, metadata=in_range(0, 0.9999))

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self._particles: Optional[ParticleModel] = None
        self._numbers: dict[str, float] = {}

    @classmethod
    def preflight(cls, guidance: Any, cfg: Any) -> None:
        super().preflight(guidance, cfg)
        guidance.check_particle_model(cfg)
        require_defaults(
            cls.Config,
            parse_structured(cls.Config, cfg.variant),
            guidance.PARTICLES_IGNORE,
            f"with {guidance.__name__}",
            prefix="system.guidance.variant.",
        )

    def particles(self, guidance: Any) -> ParticleModel:
        """Return the particle model, which is built on first use, when the networks are loaded."""
        if self._particles is None:
            self._particles = guidance.particle_model(self.cfg)
        return self._particles

    def error(
        self, guidance: Any, latents: Float[Tensor, "B c h w"], condition: Any, batch: Batch
    ) -> Error:
        noised = guidance.add_noise(latents)
        eps = guidance.predict_noise(noised.z, noised.t, condition)
        own = self.particles(guidance).predict(guidance, noised, condition, batch)
        return eps - own, noised.abar

    def learn(
        self,
        guidance: Any,
        latents: Float[Tensor, "B c h w"],
        condition: Any,
        batch: Batch,
        good: Bool[Tensor, " B"],
    ) -> None:
        renders = Renders(latents, condition, batch)
        if not good.all():
            rows = good.nonzero()[:, 0]
            seen = items_of(batch, len(latents), rows.cpu())
            renders = Renders(latents[rows], guidance.select(condition, rows), seen)
        self._numbers = self.particles(guidance).learn(guidance, renders)

    def report(self) -> dict[str, float]:
        return self._numbers

    def state(self) -> dict[str, Tensor]:
        return self._particles.state() if self._particles else {}

    def restore(self, guidance: Any, state: dict[str, Tensor]) -> None:
        self.particles(guidance).restore(state)
