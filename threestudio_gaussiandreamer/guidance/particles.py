"""Models of the distribution of the renders themselves, which VSD trains beside the cloud.

VSD's error is eps_pretrained - eps_particles, where eps_particles is the noise that an optimal
denoiser of the renders would predict (``variants/vsd.py``). For text-to-image models it is the same
UNet with a LoRA (``lora.py``). For a score in closed form there is no network to adapt, so the
renders' distribution has a closed form too: one Gaussian."""

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.distributed import all_sum
from ..core.errors import UserError
from ..diffusion import sds
from .score_pictures import Noised

if TYPE_CHECKING:
    from .score_model import ScoreModel

State = dict[str, Tensor]


class Renders(NamedTuple):
    """The renders of a step that a particle model learns from; there may be none."""

    latents: Float[Tensor, "B c h w"]
    condition: Any
    """The guidance's conditions of these items."""
    batch: dict[str, Any]
    """The host's batch of these items."""


class ParticleModel(ABC):
    """Predicts the noise in noisy renders, and learns from renders."""

    @abstractmethod
    def predict(
        self, score: "ScoreModel", noised: Noised, condition: Any, batch: dict[str, Any]
    ) -> Float[Tensor, "B c h w"]:
        """Predict the noise; called without gradients."""

    @abstractmethod
    def learn(self, score: "ScoreModel", renders: Renders) -> dict[str, float]:
        """Learn from the renders of a step; return numbers to log."""

    @abstractmethod
    def state(self) -> State:
        """Return all that a resumed run needs."""

    @abstractmethod
    def restore(self, state: State) -> None:
        """Restore what :meth:`state` returned.

        Raises:
            UserError: names or shapes differ.
        """


class GaussianParticles(ParticleModel):
    """The renders as one Gaussian per element, N(m, s^2), of all cameras together.

    m and s^2 are moving averages over the renders of recent steps. With z = a x + sigma eps as in
    ``sds.py``, the optimal denoiser of this Gaussian is

        eps(z) = sigma (z - a m) / (a^2 s^2 + sigma^2),

    the minimum of VSD's training objective among denoisers that are affine in each element. Before
    the first step there are no renders, and the noise itself is returned, as in SDS.

    Args:
        momentum: share of the moving averages that a step keeps, in [0, 1).
    """

    def __init__(self, momentum: float) -> None:
        self.momentum = momentum
        self._state: State = {}

    def predict(
        self, score: "ScoreModel", noised: Noised, condition: Any, batch: dict[str, Any]
    ) -> Float[Tensor, "B c h w"]:
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
    def learn(self, score: "ScoreModel", renders: Renders) -> dict[str, float]:
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
        return dict(self._state)

    def restore(self, state: State) -> None:
        if state and set(state) != {"weight", "mean", "square"}:
            raise UserError(
                f"the checkpoint's particle model has {', '.join(sorted(state))}, this one a mean "
                "and a mean square: resume with the configuration that the run was started with"
            )
        self._state = dict(state)
