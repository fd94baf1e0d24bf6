"""Train the judge, a classifier that evaluates the other networks, on data of a separate seed."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.streams import numpy_generator
from .loop import MixedData, Options, Stage, StepData, moved
from .models import Judge, accuracies, classified
from .splat_shards import SplatShards
from .views import Shards, with_backgrounds

SEED_OFFSET = 1000
"""Added to the seed, so that the judge and the other networks have no training pictures in common.
"""
CAST_EVERY = 3
"""One step in so many is of ray-cast pictures, the others of renders of Gaussians."""


def judge_shards(options: Options) -> tuple[Shards, SplatShards]:
    """Return the judge's training data: ray-cast objects, and other objects as Gaussians."""
    casts = dataclasses.replace(options.shards, seed=options.seed + SEED_OFFSET)
    return casts, SplatShards(casts.folder, casts.seed + 1, objects=casts.objects)


class JudgeBatch(NamedTuple):
    images: Float[Tensor, "B 3 s s"]
    labels: Int[Tensor, "B L"]


class JudgeData(StepData):
    stream = "judge"

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> JudgeBatch:
        shard = self.shards.get(index)
        images = with_backgrounds(shard.rgba[rows], rng, random_share=0.5)
        return JudgeBatch(images, torch.from_numpy(shard.labels[rows]))


class JudgeSplatData(JudgeData):
    stream = "judge-splats"


class JudgeStage(Stage):
    """Minimise the cross entropy of every attribute on renders of Gaussians and, in one step of
    CAST_EVERY, on ray-cast pictures.
    """

    name = "judge"
    batch_size = 64
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.shards, self.splats = judge_shards(self.options)
        return Judge().to(memory_format=torch.channels_last)  # 1.5 times faster on a CPU

    def data(self) -> MixedData:
        rest = (self.batch, self.options.pool)
        casts, splats = JudgeData(self.shards, *rest), JudgeSplatData(self.splats, *rest)
        return MixedData(casts, splats, CAST_EVERY)

    def loss(self, model: nn.Module, batch: JudgeBatch) -> tuple[Tensor, dict[str, Tensor]]:
        images = batch.images.contiguous(memory_format=torch.channels_last)
        loss, right = classified(model(images), batch.labels)
        return loss, {"right": right}

    @functools.cached_property
    def held_out(self) -> list[JudgeBatch]:
        """Return withheld objects, which no training saw: ray-cast, and as Gaussians."""
        seed, batches = self.shards.seed, []
        for sort in (self.shards, dataclasses.replace(self.splats, seed=seed)):
            shard = sort.held_out_shard()
            rng = numpy_generator(seed, "judge-held-out")
            images = with_backgrounds(shard.rgba, rng, random_share=0)
            batches.append(moved(JudgeBatch(images, torch.from_numpy(shard.labels)), self.device))
        return batches

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Return the share recognised of each attribute, and the mean of all in renders of
        Gaussians.
        """
        found, in_splats = (accuracies(model(one.images), one.labels) for one in self.held_out)
        return found | {"mean_in_renders_of_gaussians": float(np.mean(list(in_splats.values())))}
