"""Train the judge, a classifier that evaluates the other networks, on data of a separate seed.

Most of its pictures show objects as Gaussians with errors, as results of score distillation, whose
blurred edges a classifier of ray-cast pictures alone takes for other colours."""

import dataclasses
import functools
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from scipy.spatial import cKDTree
from torch import Tensor, nn

from ..cameras import Orbit
from ..core.streams import numpy_generator
from ..meshes.mesh import Mesh, face_areas, sample_surface, surface_colors
from . import recognition
from .loop import Batches, Options, Stage, mixed_batch, moved
from .models import Judge, accuracies, classified
from .views import LABELS, Shard, Shards, exchanged, render_gaussians, with_backgrounds

SEED_OFFSET = 1000
"""Added to the seed, so that the judge has training pictures of its own."""
CAST_EVERY = 3
"""One step in so many is of ray-cast pictures, the others of renders of Gaussians."""
SPLATS_VERSION = 1
"""Changes with :func:`imperfect_gaussians`, so that no training reads earlier pictures."""
COUNT, BLENDED = (800, 4000), 12
"""Range of the number of Gaussians, and of how many neighbours at most colours are averaged."""
WAVES, WAVELENGTH = 6, (0.15, 0.8)
"""Number of plane waves of a smooth error, and the range of their lengths, world units."""
SHIFT = 6
"""Largest shift of a batch's pictures, pixels."""
COLOR_SHIFT, SHAPE_SHIFT, COLOR_ERROR, COLOR_NOISE = 0.06, 0.025, 0.08, 0.12
"""Largest deviations of smooth displacements of pattern and shape, world units; of smooth errors of
the colour, and of errors of each Gaussian's."""


class SplatShards(Shards):
    """Shards whose pictures are renders of :func:`imperfect_gaussians`."""

    file_names = f"splats{SPLATS_VERSION}", f"held-out-splats{SPLATS_VERSION}"

    def pictures(
        self, mesh: Mesh, orbit: Orbit, rng: np.random.Generator
    ) -> Float[np.ndarray, "N s s 4"]:
        return render_gaussians(imperfect_gaussians(mesh, rng), orbit, eps2d=0.1)  # as toybox.yaml


def imperfect_gaussians(mesh: Mesh, rng: np.random.Generator) -> tuple[np.ndarray, ...]:
    """Cover a surface with Gaussians, the first arguments of ``rasterize``, whose pattern, shape
    and colours have errors of random sizes up to the constants above."""
    count = int(rng.integers(*COUNT))
    points, faces, barycentric = sample_surface(mesh, count, rng)
    colors = surface_colors(mesh, faces, barycentric)
    looked_up = points + smooth_field(points, COLOR_SHIFT * rng.uniform(), rng)
    _, near = cKDTree(points).query(looked_up, k=np.arange(1, rng.integers(2, BLENDED + 2)))
    colors = colors[near].mean(axis=1) + smooth_field(points, COLOR_ERROR * rng.uniform(), rng)
    colors = colors + rng.normal(0, COLOR_NOISE * rng.uniform(), (count, 3))
    means = points + smooth_field(points, SHAPE_SHIFT * rng.uniform(), rng)
    spacing = np.sqrt(face_areas(mesh).sum() / count)
    scales = spacing * rng.uniform(0.4, 0.9) * rng.uniform(0.6, 1.6, (count, 3))
    opacities = rng.uniform(0.5, 1.0) * rng.uniform(0.6, 1.0, count)
    return means, rng.normal(size=(count, 4)), scales, opacities, colors.clip(0, 1)


def smooth_field(
    points: Float[np.ndarray, "P 3"], deviation: float, rng: np.random.Generator
) -> Float[np.ndarray, "P 3"]:
    """Return a random sum of plane waves at these points, whose components have this deviation."""
    directions = rng.normal(size=(3, WAVES))
    lengths = rng.uniform(*WAVELENGTH, WAVES)
    waves = 2 * np.pi * directions / (np.linalg.norm(directions, axis=0) * lengths)
    phases = points @ waves + rng.uniform(0, 2 * np.pi, WAVES)
    return np.sin(phases) @ rng.normal(0, deviation * np.sqrt(2 / WAVES), (WAVES, 3))


def judge_shards(options: Options) -> tuple[Shards, SplatShards]:
    """Return the judge's training data: ray-cast objects, and other objects as Gaussians."""
    casts = dataclasses.replace(options.shards, seed=options.seed + SEED_OFFSET)
    return casts, SplatShards(casts.folder, casts.seed + 1, objects=casts.objects)


class JudgeBatch(NamedTuple):
    images: Float[Tensor, "B 3 s s"]
    labels: Int[Tensor, "B L"]

    @property
    def persons(self) -> Bool[Tensor, " B"]:
        return self.labels[:, list(LABELS).index("action")] > 0


def judge_batch(
    shards: Shards, index: int, rows: np.ndarray, rng: np.random.Generator
) -> JudgeBatch:
    """Draw a background for each of these pictures, shift them, and mirror half of the persons."""
    shard = shards.get(index)
    rgba = np.roll(shard.rgba[rows], rng.integers(-SHIFT, SHIFT + 1, 2), (1, 2))
    images = with_backgrounds(rgba, rng, random_share=0.5)
    batch = JudgeBatch(images, judge_labels(shard, rows))
    flipped = batch.persons & torch.from_numpy(rng.random(len(rows)) < 0.5)
    images[flipped] = images[flipped].flip(-1)
    batch.labels[flipped] = mirrored(batch.labels[flipped])
    return batch


def judge_labels(shard: Shard, rows: np.ndarray) -> Int[Tensor, "B L"]:
    """Return labels in which the sides of actions are those of the picture: exchanged if seen from
    behind, which needs no knowledge of where the front is."""
    labels, column = torch.from_numpy(shard.labels[rows]), list(LABELS).index("action")
    action = labels[:, column]
    behind = recognition.behind(torch.from_numpy(shard.azimuth[rows]))
    labels[:, column] = torch.where(behind, exchanged("action")[action], action)
    return labels


def mirrored(labels: Int[Tensor, "B L"]) -> Int[Tensor, "B L"]:
    """Exchange left and right in the classes of mirrored persons; those of objects may differ."""
    return torch.stack([exchanged(name)[labels[:, i]] for i, name in enumerate(LABELS)], 1)


class JudgeStage(Stage):
    """Classify renders of Gaussians and, in one step of CAST_EVERY, ray-cast pictures."""

    name = "judge"
    batch_size = 64
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.shards, self.splats = judge_shards(self.options)
        return Judge().to(memory_format=torch.channels_last)  # 1.5 times faster on a CPU

    def data(self) -> Batches:
        splats = self.steps(judge_batch, shards=self.splats, stream="judge-splats")
        return functools.partial(mixed_batch, self.steps(judge_batch), splats, CAST_EVERY)

    def loss(self, model: nn.Module, batch: JudgeBatch) -> tuple[Tensor, dict[str, Tensor]]:
        loss, right = classified(model(batch.images, batch.persons), batch.labels)
        return loss, {"right": right}

    def held_out(self) -> list[JudgeBatch]:
        """Return withheld objects, which no training saw: ray-cast, and as Gaussians."""
        seed, batches = self.shards.seed, []
        for sort in (self.shards, dataclasses.replace(self.splats, seed=seed)):
            shard = sort.held_out_shard()
            rng = numpy_generator(seed, "judge-held-out")
            images = with_backgrounds(shard.rgba, rng, random_share=0)
            labels = judge_labels(shard, np.arange(len(images)))
            batches.append(moved(JudgeBatch(images, labels), self.device))
        return batches

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        data = self.held_out()
        found, in_splats = (accuracies(model(b.images, b.persons), b.labels) for b in data)
        return found | {"mean_in_renders_of_gaussians": float(np.mean(list(in_splats.values())))}
