"""Training views that are drawn where the error is large. They aren't part of the package, since
they gain nothing; docs/distillation.md has their figures.

    python -m benchmarks.quality.variants --lines "SDS, views by error" "SDS, views by its square"

The guidance measures the distance of each view's denoised latents from those of the render,
relative to the mean of other views at about the same timestep, and averages it over sixteen sectors
of azimuth. The data module draws half of the views uniformly, and the others in proportion to a
power of their sector's error.

====================  ==============================================================================
option                meaning
====================  ==============================================================================
data.error_power      power of the error; 0: all views are drawn uniformly
====================  ==============================================================================
"""

from dataclasses import dataclass, field
from typing import Any, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

from threestudio_gaussiandreamer.core.options import in_range
from threestudio_gaussiandreamer.guidance.exact_score import ExactScoreGuidance
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.training.data import (
    CameraConfig,
    GaussianDreamerDataModule,
    TrainCameras,
)

SECTORS, TIMESTEP_BINS = 16, 10
KEPT = 0.9
"""Share of a mean that stays when a value is added to it."""
UNIFORM = 0.5
"""Share of the views that are drawn uniformly."""


class SectorErrors:
    """Mean relative errors of the sectors, 1 before any is known."""

    def __init__(self) -> None:
        self.means = torch.ones(SECTORS)
        self._of_timesteps: dict[int, float] = {}

    def add(self, azimuth: float, share_of_timesteps: float, error: float) -> None:
        """Add the error of a view.

        Args:
            azimuth: degrees.
        """
        timestep = int(share_of_timesteps * TIMESTEP_BINS)
        usual = self._of_timesteps.get(timestep, error)
        self._of_timesteps[timestep] = KEPT * usual + (1 - KEPT) * error
        sector = int(azimuth % 360 / 360 * SECTORS) % SECTORS
        self.means[sector] = KEPT * self.means[sector] + (1 - KEPT) * error / max(usual, 1e-12)


@register("error-measuring-guidance")
class ErrorMeasuringGuidance(ExactScoreGuidance):
    """The exact score, which measures the errors of the views that it is given."""

    errors: Optional[SectorErrors] = None
    """Of the last guidance of the process, for its data module."""

    def configure(self) -> None:
        super().configure()
        type(self).errors = SectorErrors()

    def _error(self, latents: Tensor, condition: Any, batch: dict[str, Any], *flags: bool) -> Any:
        found = super()._error(latents, condition, batch, *flags)
        (error, abar), _ = found
        distances = torch.linalg.vector_norm(error.flatten(1), dim=1)
        distances = distances * ((1 - abar) / abar).sqrt()
        shares = (self.alphas_cumprod > abar[:, None]).double().mean(1)
        for view in zip(*(x.tolist() for x in (batch["azimuth"], shares, distances)), strict=True):
            self.errors.add(*view)
        return found


class ErrorCameras(TrainCameras):
    """Training cameras of a pool, of which those with a large error are drawn more often."""

    def _pick(self, batch_size: int, rng: torch.Generator) -> Int[Tensor, " B"]:
        index = super()._pick(batch_size, rng)
        uniform = torch.rand(batch_size, generator=rng) < UNIFORM
        weights = self._weights().cumsum(0)
        position = (index + 0.5) / len(weights) * weights[-1]  # sectors of a batch stay apart
        return torch.where(uniform, index, torch.searchsorted(weights, position))

    def _weights(self) -> Float[Tensor, " V"]:
        """Return the weight of each view of the pool."""
        sectors = (self.pool.azimuth % 360 / 360 * SECTORS).long() % SECTORS
        return ErrorMeasuringGuidance.errors.means[sectors] ** self.cfg.error_power


@register("error-views-datamodule")
class ErrorViewsDataModule(GaussianDreamerDataModule):
    """Training views by their errors, which ``error-measuring-guidance`` measures."""

    @dataclass
    class Config(CameraConfig):
        error_power: float = field(default=1.0, metadata=in_range(0, 10))

    def setup(self, stage: str | None = None) -> None:
        super().setup(stage)
        if stage in (None, "fit"):
            self.train_dataset = ErrorCameras(self.options)
