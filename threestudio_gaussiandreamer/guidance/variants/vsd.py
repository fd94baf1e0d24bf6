"""``vsd-variant``: variational score distillation (Wang et al. 2023, ProlificDreamer, eq. 9).

    e = eps_hat(z_t, t) - eps_particles(z_t, t, camera)

eps_particles predicts the noise in the renders' own distribution; it is trained beside the cloud to
minimise E |eps_particles(z_t, t, camera) - eps|^2 on the renders (eq. 8). For text-to-image models
it is the UNet with a LoRA in its attention (``guidance/lora.py``). For a score in closed form it is
the optimal denoiser of a Gaussian with the renders' running mean and variance, of all cameras
together (:class:`GaussianParticles`): a perfect model of a single cloud's renders would give SDS,
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
from typing import Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ...core.distributed import all_sum
from ...core.errors import UserError
from ...core.options import in_range, positive, require_defaults
from ...diffusion import sds
from ...host import parse_structured, register
from ..types import Batch, Good, Latents, Noised, Residual, State, items_of
from .base import Variant


class Renders(NamedTuple):
    """The renders of a step that a particle model learns from; there may be none."""

    latents: Latents
    condition: Any
    """The guidance's conditions of these items."""
    batch: Batch
    """The host's batch of these items."""


class GaussianParticles:
    """The renders as one Gaussian per element, N(m, s^2), of all cameras together.

    m and s^2 are moving averages over the renders of recent steps. With z = a x + sigma eps as in
    ``diffusion/sds.py``, the optimal denoiser of this Gaussian is

        eps(z) = sigma (z - a m) / (a^2 s^2 + sigma^2),

    the minimum of VSD's training objective among denoisers that are affine in each element. Before
    the first step there are no renders, and the noise itself is returned, as in SDS.

    Args:
        momentum: share of the moving averages that a step keeps, in [0, 1).
    """

    def __init__(self, momentum: float) -> None:
        self.momentum = momentum
        self._state: State = {}

    def predict(self, score: Any, noised: Noised, condition: Any, batch: Batch) -> Latents:
        """Predict the noise; called without gradients."""
        if self._state.get("mean", noised.z[:0]).shape != noised.z.shape[1:]:
            return noised.noise
        mean, variance = (value.to(noised.z) for value in self._moments())
        abar = sds.per_item(noised.abar, noised.z)
        sigma = sds.per_item((1 - noised.abar).sqrt(), noised.z)
        residual = noised.z - sds.per_item(noised.abar.sqrt(), noised.z) * mean
        return sigma * residual / (abar * variance + sigma**2)

    def _moments(self) -> tuple[Float[Tensor, "c h w"], Float[Tensor, "c h w"]]:
        """Return mean and variance of the renders."""
        mean, square = (self._state[name] / self._state["weight"] for name in ("mean", "square"))
        return mean, (square - mean**2).clamp_min(0)

    @torch.no_grad()
    def learn(self, score: Any, renders: Renders) -> dict[str, float]:
        """Learn from the renders of a step; return numbers to log."""
        seen = renders.latents
        count = all_sum(seen.new_tensor(float(len(seen))))
        total, square = all_sum(seen.sum(0)), all_sum(seen.square().sum(0))
        if not count:
            return {}
        new = {"weight": torch.ones_like(count), "mean": total / count, "square": square / count}
        old = self._state
        if old.get("mean", seen[:0]).shape != seen.shape[1:]:
            old = {name: torch.zeros_like(value) for name, value in new.items()}
        self._state = {
            name: self.momentum * old[name].to(value) + (1 - self.momentum) * value
            for name, value in new.items()
        }
        return {}

    def state(self) -> State:
        """Return all that a resumed run needs."""
        return dict(self._state)

    def restore(self, state: State) -> None:
        """Restore what :meth:`state` returned.

        Raises:
            UserError: names or shapes differ.
        """
        if state and set(state) != {"weight", "mean", "square"}:
            raise UserError(
                f"the checkpoint's particle model has {', '.join(sorted(state))}, this one a mean "
                "and a mean square: resume with the configuration that the run was started with"
            )
        self._state = dict(state)


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
        self._particles: Any = None
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

    def particles(self, guidance: Any) -> Any:
        """Return the particle model, which is built on first use, when the networks are loaded."""
        if self._particles is None:
            self._particles = guidance.particle_model(self.cfg)
        return self._particles

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        noised = guidance.add_noise(latents)
        eps = guidance.predict_noise(noised.z, noised.t, condition)
        own = self.particles(guidance).predict(guidance, noised, condition, batch)
        return eps - own, noised.abar

    def learn(
        self, guidance: Any, latents: Latents, condition: Any, batch: Batch, good: Good
    ) -> None:
        renders = Renders(latents, condition, batch)
        if not good.all():
            rows = good.nonzero()[:, 0]
            seen = items_of(batch, len(latents), rows.cpu())
            renders = Renders(latents[rows], guidance.select(condition, rows), seen)
        self._numbers = self.particles(guidance).learn(guidance, renders)

    def report(self) -> dict[str, float]:
        return self._numbers

    def state(self) -> State:
        return self._particles.state() if self._particles else {}

    def restore(self, guidance: Any, state: State) -> None:
        self.particles(guidance).restore(state)
