"""Train the judge, a classifier that evaluates the other networks, on data of a separate seed."""

import functools
from typing import ClassVar, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.streams import numpy_generator
from .batches import MixedData, StepData, moved, normal
from .classifiers import accuracies, classified
from .loop import Options, Stage
from .models import Judge
from .splat_shards import SplatShards
from .text_batches import label_tensor
from .views import Shards, held_out_shard, with_backgrounds

SEED_OFFSET = 1000
"""Added to the seed, so that the judge and the other networks have no training pictures in common.
"""
CAST_EVERY = 3
"""One step in so many is of ray-cast pictures, the others of renders of Gaussians."""


def judge_shards(options: Options) -> tuple[Shards, SplatShards]:
    """Return the judge's training data: ray-cast objects, and other objects as Gaussians."""
    seed = options.seed + SEED_OFFSET
    return options.shards(seed), SplatShards(
        options.shards_folder(), seed + 1, objects=options.shard_objects
    )


class JudgeBatch(NamedTuple):
    images: Float[Tensor, "B 3 s s"]
    labels: Int[Tensor, "B L"]


class JudgeData(StepData):
    stream = "judge"
    degrades: ClassVar[bool] = True
    """Whether most pictures are blurred, noisy or mottled."""

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> JudgeBatch:
        shard = self.shards.get(index)
        images = with_backgrounds(shard.rgba[rows], rng, random_share=0.5)
        images = degraded(images, rng) if self.degrades else images
        return JudgeBatch(images, label_tensor(shard, rows))


class JudgeSplatData(JudgeData):
    """Batches of renders of Gaussians, which are imperfect themselves."""

    stream = "judge-splats"
    degrades = False


class JudgeStage(Stage):
    """Minimise the cross entropy of every attribute on renders of Gaussians and, in one step of
    CAST_EVERY, on clean and degraded ray-cast pictures.
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
        loss, right = classified(
            model(batch.images.contiguous(memory_format=torch.channels_last)), batch.labels
        )
        return loss, {"right": right}

    @functools.cached_property
    def held_out(self) -> list[JudgeBatch]:
        """Return withheld objects, which no training saw: ray-cast, and as Gaussians."""
        folder, seed, batches = self.options.shards_folder(), self.shards.seed, []
        for sort in (Shards, SplatShards):
            shard = held_out_shard(folder, seed, sort)
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


def degraded(
    images: Float[Tensor, "B 3 s s"], rng: np.random.Generator
) -> Float[Tensor, "B 3 s s"]:
    """Blur a quarter of the batch, add noise to another, make another one mottled."""
    clean, *others = images.tensor_split(4)
    pairs = zip(DEGRADATIONS, others, strict=True)
    return torch.cat([clean, *(f(part, rng) if len(part) else part for f, part in pairs)])


def blurred(images: Float[Tensor, "B 3 s s"], rng: np.random.Generator) -> Float[Tensor, "B 3 s s"]:
    """Shrink the pictures by a random factor up to 2, and enlarge them again."""
    size = images.shape[-1]
    small = (int(rng.integers(size // 2, size)),) * 2
    small_images = F.interpolate(images, small, mode="bilinear", antialias=True)
    return F.interpolate(small_images, (size, size), mode="bilinear")


def noisy(images: Float[Tensor, "B 3 s s"], rng: np.random.Generator) -> Float[Tensor, "B 3 s s"]:
    """Add normal noise of a random standard deviation up to 0.06."""
    return (images + rng.uniform(0, 0.06) * normal(rng, images.shape)).clamp(0, 1)


def mottled(images: Float[Tensor, "B 3 s s"], rng: np.random.Generator) -> Float[Tensor, "B 3 s s"]:
    """Vary colours and positions smoothly over a few pixels, as in renders of coarse Gaussians.

    Before the interpolation, which lowers both, colours have a standard deviation of up to 0.1 and
    shifts one of up to 1.5 pixels.
    """
    count, _, size, _ = images.shape
    grid = size // int(rng.integers(2, 8))
    field = F.interpolate(normal(rng, (count, 5, grid, grid)), (size, size), mode="bilinear")
    moves = field[:, 3:].movedim(1, -1) * rng.uniform(0, 1.5) * 2 / size
    places = F.affine_grid(torch.eye(2, 3).expand(count, 2, 3), list(images.shape), False) + moves
    moved = F.grid_sample(images, places, padding_mode="border", align_corners=False)
    return (moved + rng.uniform(0, 0.1) * field[:, :3]).clamp(0, 1)


DEGRADATIONS = (blurred, noisy, mottled)
