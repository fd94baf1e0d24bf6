"""One prediction of the score model for several consecutive steps of the same views.

The variant's error e of the latent x defines a target, the denoised latent for SDS:

    y = x - sqrt((1 - abar) / abar) e

While cameras and background stay the same (``data.hold_steps``, ``background.hold_steps``), y is
kept for ``reuse_steps`` steps, so that only the renders are new, and the error of a step is

    e' = sqrt(abar / (1 - abar)) (x' - y) = e + sqrt(abar / (1 - abar)) (x' - x).

Instruct-NeRF2NeRF (Haque et al. 2023, arXiv:2303.12789) keeps the targets of its views likewise."""

from collections.abc import Callable
from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.checkpoint_file import entries_below
from ..core.distributed import all_sum, world_size
from ..diffusion.sds import per_item

SAME = ("c2w", "fovy", "comp_rgb_bg")
"""Entries of the batch that must not change."""

PREFIX = "kept."
"""Of the names of the tensors in a checkpoint."""

Error = tuple[Float[Tensor, "B c h w"], Float[Tensor, " B"]]


class Kept(NamedTuple):
    """A prediction, and where it was made."""

    step: int
    latents: Float[Tensor, "B c h w"]
    error: Float[Tensor, "B c h w"]
    abar: Float[Tensor, " B"]
    views: dict[str, Tensor]


class KeptPrediction:
    """The last prediction, for ``steps`` steps in all."""

    def __init__(self, steps: int) -> None:
        self.steps = steps
        self._kept: Optional[Kept] = None

    def error(
        self,
        step: int,
        latents: Float[Tensor, "B c h w"],
        batch: dict[str, Any],
        predict: Callable[[], Error],
    ) -> tuple[Error, bool]:
        """Return the error of the latents, and whether ``predict`` was called for it."""
        kept = self._kept
        if kept is not None and self._is_valid(kept, step, latents, batch):
            slope = per_item((kept.abar / (1 - kept.abar)).sqrt(), latents)
            return (kept.error + slope * (latents - kept.latents), kept.abar), False
        error, abar = predict()
        self._kept = None
        # all processes keep theirs or none does, so that all predict in the same steps
        if self.steps > 1 and not all_sum((~error.isfinite()).any().float()):
            views = {name: batch[name].detach() for name in SAME if batch.get(name) is not None}
            self._kept = Kept(step, latents.detach(), error, abar, views)
        return (error, abar), True

    def state(self) -> dict[str, Tensor]:
        """Return the kept tensors by name, for a checkpoint."""
        if self._kept is None:
            return {}
        named = self._kept._asdict() | {"step": torch.tensor(self._kept.step)}
        named |= {f"views.{name}": value for name, value in named.pop("views").items()}
        return {PREFIX + name: value for name, value in named.items()}

    def restore(
        self, state: dict[str, Tensor], device: torch.device | str = "cpu"
    ) -> dict[str, Tensor]:
        """Restore what :meth:`state` returned; return the entries of others.

        With several processes nothing is restored: the checkpoint has the first one's prediction
        only, and all must predict in the same steps.
        """
        own = {name: value.to(device) for name, value in entries_below(state, PREFIX).items()}
        if own and self.steps > 1 and world_size() == 1:
            views = {name: own[f"views.{name}"] for name in SAME if f"views.{name}" in own}
            latents, error, abar = (own[name] for name in ("latents", "error", "abar"))
            self._kept = Kept(int(own["step"]), latents, error, abar, views)
        return {name: value for name, value in state.items() if not name.startswith(PREFIX)}

    def _is_valid(self, kept: Kept, step: int, latents: Tensor, batch: dict[str, Any]) -> bool:
        return (
            0 <= step - kept.step < self.steps
            and kept.latents.shape == latents.shape
            and all(
                name in batch and torch.equal(batch[name], value)
                for name, value in kept.views.items()
            )
        )
