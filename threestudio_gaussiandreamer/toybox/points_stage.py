"""Training the text-to-points model in Point-E's format, on CLIP's text features."""

from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ..diffusion import sds
from ..priors.karras import cosine_alphas_cumprod
from ..priors.point_e import BIASES, SCALES, BaseModel, mean_of
from . import models
from .clip_stage import text_features, trained_clip
from .loop import Batches, Stage, normal, torch_generator
from .tokens import object_prompts, token_ids
from .views import Shards
from .world import RADIUS

POINTS, TIMESTEPS, EMPTY_SHARE = 256, 1024, 0.1
"""Points of a training sample, timesteps of Point-E's diffusion, share of empty prompts."""


class PointsBatch(NamedTuple):
    points: Float[Tensor, "B 6 N"]
    """In the network's units, about [-1, 1]."""
    noise: Float[Tensor, "B 6 N"]
    t: Int[Tensor, " B"]
    ids: Int[Tensor, "B 32"]
    empty: Bool[Tensor, " B"]


def points_batch(
    shards: Shards, tokenizer: Any, index: int, rows: np.ndarray, rng: np.random.Generator
) -> PointsBatch:
    """Draw points, a timestep, noise and a prompt for each of these objects."""
    shard = shards.get(index)
    texts = object_prompts(shard.labels[rows * shards.views], rng)
    chosen = rng.permuted(np.tile(np.arange(shard.points.shape[1]), (len(rows), 1)), axis=1)
    places = np.take_along_axis(shard.points[rows], chosen[:, :POINTS, None], axis=1)
    points = network_units(torch.from_numpy(places).float())
    noise = normal(rng, points.shape)
    t = sds.stratified_timesteps(len(rows), TIMESTEPS, torch_generator(rng))
    empty = torch.from_numpy(rng.uniform(size=len(rows)) < EMPTY_SHARE)
    return PointsBatch(points, noise, t, token_ids(tokenizer, texts), empty)


class PointsStage(Stage):
    """Minimise Point-E's own loss: the squared error of the noise, with the cosine schedule."""

    name = "points"
    batch_size = 32
    learning_rate = 8e-4
    images = 400_000

    def build(self) -> nn.Module:
        self.tokenizer, self.clip = trained_clip(self.options.folder, "text", self.device)
        self.alphas_cumprod = torch.from_numpy(cosine_alphas_cumprod()).to(self.device)
        width, layers = models.POINTS_WIDTH, models.POINTS_LAYERS
        return BaseModel(width=width, layers=layers, features=models.FEATURES)

    def data(self) -> Batches:
        return self.steps(points_batch, self.tokenizer, per_object=True)

    def loss(self, model: nn.Module, batch: PointsBatch) -> tuple[Tensor, dict[str, Tensor]]:
        condition = self.condition(batch.ids) * ~batch.empty[:, None]
        z = sds.diffuse(batch.points, batch.noise, self.alphas_cumprod[batch.t])
        errors = (mean_of(model, condition)(z, batch.t).float() - batch.noise).square()
        parts = {"mse_points": errors[:, :3].mean(), "mse_colors": errors[:, 3:].mean()}
        return errors.mean(), parts

    def condition(self, ids: Int[Tensor, "B 32"]) -> Float[Tensor, "B D"]:
        """Return CLIP's text features with unit variance, as the Point-E prior gives them."""
        features = text_features(self.clip.text_model, self.clip.text_projection, ids)
        return features * features.shape[-1] ** 0.5


def network_units(points: Float[Tensor, "B N 6"]) -> Float[Tensor, "B 6 N"]:
    """Convert points of the world to the units of Point-E's networks: their front is -y and their
    unit 2 RADIUS; then follow the published scales and biases."""
    x, y, z = (points[..., i] / (2 * RADIUS) for i in range(3))
    turned = torch.stack([y, -x, z, *(255 * points[..., i] for i in (3, 4, 5))], dim=1)
    return turned * SCALES + BIASES
