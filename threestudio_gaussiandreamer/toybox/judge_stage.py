"""Train the judge, a classifier that evaluates the other networks, on data of a separate seed."""

import functools
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.streams import numpy_generator
from .batches import StepData
from .classifiers import accuracies, classified
from .loop import Stage
from .models import Judge
from .text_batches import label_tensor
from .views import held_out_shard, with_backgrounds

SEED_OFFSET = 1000
"""Added to the seed, so that the judge and the other networks have no training pictures in common.
"""


class JudgeBatch(NamedTuple):
    images: Float[Tensor, "B 3 s s"]
    labels: Int[Tensor, "B L"]


class JudgeData(StepData):
    stream = "judge"

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> JudgeBatch:
        shard = self.shards.get(index)
        images = with_backgrounds(shard.rgba[rows], rng, random_share=0.5)
        return JudgeBatch(degraded(images, rng), label_tensor(shard, rows))


class JudgeStage(Stage):
    """Minimise the cross entropy of every attribute on clean, blurred and noisy pictures."""

    name = "judge"
    batch_size = 64
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.seed = self.options.seed + SEED_OFFSET
        self.shards = self.options.shards(self.seed)
        return Judge()

    def data(self) -> JudgeData:
        return JudgeData(self.shards, self.batch, self.options.pool)

    def loss(self, model: nn.Module, batch: JudgeBatch) -> tuple[Tensor, dict[str, Tensor]]:
        loss, right = classified(model(batch.images), batch.labels)
        return loss, {"right": right}

    @functools.cached_property
    def held_out(self) -> JudgeBatch:
        """Return withheld objects, which no training saw."""
        shard = held_out_shard(self.options.shards_folder(), self.seed)
        images = with_backgrounds(
            shard.rgba, numpy_generator(self.seed, "judge-held-out"), random_share=0
        )
        return JudgeBatch(images.to(self.device), torch.from_numpy(shard.labels).to(self.device))

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        return accuracies(model(self.held_out.images), self.held_out.labels)


def degraded(
    images: Float[Tensor, "B 3 s s"], rng: np.random.Generator
) -> Float[Tensor, "B 3 s s"]:
    """Blur a third of the batch by shrinking and enlarging it, and add noise to another third."""
    third = len(images) // 3
    size = images.shape[-1]
    small = F.interpolate(
        images[:third], (int(rng.integers(size // 2, size)),) * 2, mode="bilinear", antialias=True
    )
    blurred = F.interpolate(small, (size, size), mode="bilinear") if third else images[:0]
    noise = rng.normal(0, rng.uniform(0, 0.06), images[third : 2 * third].shape).astype(np.float32)
    noisy = (images[third : 2 * third] + torch.from_numpy(noise)).clamp(0, 1)
    return torch.cat([blurred, noisy, images[2 * third :]])
