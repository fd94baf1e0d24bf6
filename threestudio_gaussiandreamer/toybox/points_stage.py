"""Training the text-to-points model in Point-E's format, on CLIP's text features."""

import math
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..cameras import Orbit, to_opencv
from ..core.streams import generator, numpy_generator
from ..diffusion import sds
from ..priors.karras import cosine_alphas_cumprod, guided_denoiser, karras_sigmas, sample_heun
from ..priors.point_e import BIASES, SCALES, mean_of
from ..splatting import rasterize
from . import models
from .batches import StepData, normal, torch_generator
from .loop import Stage
from .module_digest import digest
from .sheet import contact_sheet
from .text_batches import object_prompts, open_tokenizer, token_ids
from .text_stage import frozen_text, text_features
from .views import BACKGROUND, FOVY_DEG, VIEWS, held_out_shard
from .world import RADIUS

POINTS = 256
"""Of one training sample; a set transformer takes any number later."""
TIMESTEPS = 1024
"""Of Point-E's diffusion."""
EMPTY_SHARE = 0.1
SAMPLES, SAMPLE_POINTS, SAMPLE_STEPS, SAMPLE_GUIDANCE = 16, 512, 24, 3.0


class PointsBatch(NamedTuple):
    points: Float[Tensor, "B 6 N"]
    """In the network's units, about [-1, 1]."""
    noise: Float[Tensor, "B 6 N"]
    t: Int[Tensor, " B"]
    ids: Int[Tensor, "B 32"]
    """Tokens of the prompts."""
    empty: Tensor
    """(B,) bool: whether the condition is zero, for classifier-free guidance."""


@dataclass(frozen=True)
class PointsData(StepData):
    tokenizer: Any
    stream, per_object = "points", True

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> PointsBatch:
        shard = self.shards.get_light(index)
        texts = object_prompts(shard.labels[rows * self.shards.views], rng)
        chosen = rng.permuted(np.tile(np.arange(shard.points.shape[1]), (len(rows), 1)), axis=1)
        places = np.take_along_axis(shard.points[rows], chosen[:, :POINTS, None], axis=1)
        points = network_units(torch.from_numpy(places).float())
        return PointsBatch(
            points,
            normal(rng, points.shape),
            sds.stratified_timesteps(len(rows), TIMESTEPS, torch_generator(rng)),
            token_ids(self.tokenizer, texts),
            torch.from_numpy(rng.uniform(size=len(rows)) < EMPTY_SHARE),
        )


class PointsStage(Stage):
    """Minimise Point-E's own loss: the squared error of the noise, with the cosine schedule."""

    name = "points"
    batch_size = 32
    learning_rate = 8e-4
    images = 400_000

    def build(self) -> nn.Module:
        self.tokenizer = open_tokenizer(self.options.folder)
        self.clip = frozen_text(self.options.folder, len(self.tokenizer)).to(self.device)
        self.shards = self.options.shards()
        self.alphas_cumprod = torch.from_numpy(cosine_alphas_cumprod()).to(self.device)
        return models.points_model()

    def depends(self) -> dict[str, str]:
        return {"text": digest(self.clip.text_model)}

    def data(self) -> PointsData:
        return PointsData(self.shards, self.batch, self.options.pool, self.tokenizer)

    def loss(self, model: nn.Module, batch: PointsBatch) -> tuple[Tensor, dict[str, Tensor]]:
        condition = self.condition(batch.ids) * ~batch.empty[:, None]
        z = sds.add_noise(batch.points, batch.noise, self.alphas_cumprod[batch.t])
        predicted = mean_of(lambda z, t: model(z, t, condition))(z, batch.t).float()
        errors = (predicted - batch.noise).square()
        return errors.mean(), {
            "mse_points": errors[:, :3].mean(),
            "mse_colors": errors[:, 3:].mean(),
        }

    @torch.no_grad()
    def condition(self, ids: Int[Tensor, "B 32"]) -> Float[Tensor, "B D"]:
        """Return CLIP's text features with unit variance, as the Point-E prior gives them."""
        features = text_features(self.clip.text_model, self.clip.text_projection, ids)
        return features * features.shape[-1] ** 0.5

    @torch.no_grad()
    def sheet(self, model: nn.Module) -> np.ndarray:
        shard = held_out_shard(self.options.shards_folder(), self.options.seed)
        texts = object_prompts(
            shard.labels[::VIEWS][:SAMPLES], numpy_generator(self.options.seed, "points-sheet")
        )
        condition = self.condition(token_ids(self.tokenizer, texts).to(self.device))
        conditions = torch.cat([condition, torch.zeros_like(condition)])
        network = mean_of(lambda z, t: model(z, t, conditions))
        denoise = guided_denoiser(network, cosine_alphas_cumprod(), scale=SAMPLE_GUIDANCE)
        rng = generator(self.options.seed, "points-sheet")
        noise = torch.randn(len(texts), 6, SAMPLE_POINTS, generator=rng).to(self.device)
        sigmas = karras_sigmas(SAMPLE_STEPS, 1e-3, 120.0)
        sample = sample_heun(denoise, noise, sigmas, churn=3.0, generator=rng).cpu()
        return contact_sheet(torch.stack([drawn(points) for points in sample]), texts, columns=8)


def network_units(points: Float[Tensor, "B N 6"]) -> Float[Tensor, "B 6 N"]:
    """Convert points of the world to the units of Point-E's networks.

    Their front is -y and their unit is 2 RADIUS; then follow the published scales and biases.
    """
    x, y, z = (points[..., i] / (2 * RADIUS) for i in range(3))
    turned = torch.stack([y, -x, z, *(255 * points[..., i] for i in (3, 4, 5))], dim=1)
    return turned * SCALES + BIASES


def world_units(sample: Float[Tensor, "6 N"]) -> Float[Tensor, "N 6"]:
    """Invert :func:`network_units` for one sample."""
    x, y, z, *colors = (sample - BIASES[:, 0][:, None]) / SCALES[:, 0][:, None]
    return torch.stack(
        [-y * 2 * RADIUS, x * 2 * RADIUS, z * 2 * RADIUS, *(color / 255 for color in colors)], dim=1
    )


def drawn(sample: Float[Tensor, "6 N"], size: int = 128) -> Float[Tensor, "3 s s"]:
    """Draw a sample's points as small Gaussians, seen from the front and the left."""
    points = world_units(sample)
    angles = (15.0, 40.0, 2.25, math.radians(FOVY_DEG))
    orbit = Orbit(*(torch.tensor([float(value)]) for value in angles))
    viewmats, Ks = to_opencv(orbit.c2w, orbit.fovy, size, size)
    count = len(points)
    quats, scales = torch.tensor([1.0, 0, 0, 0]).repeat(count, 1), torch.full((count, 3), 0.02)
    colors = points[:, 3:].clamp(0, 1).contiguous()
    background = torch.tensor(BACKGROUND)
    image = rasterize(
        points[:, :3].contiguous(),
        quats,
        scales,
        torch.full((count,), 0.9),
        colors,
        viewmats,
        Ks,
        size,
        size,
        background=background,
    ).image[0]
    return image.movedim(-1, 0)
