"""Train the autoencoder on clean pictures and on renders of rough Gaussians, since score
distillation encodes such renders in its first iterations."""

import math
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor, nn

from ..cameras import Orbit
from ..core.streams import numpy_generator
from . import models
from .loop import Batches, Stage, is_trained, normal
from .views import DISTANCE, FOVY_DEG, Shard, Shards, render_gaussians, with_backgrounds

RANDOM_BACKGROUNDS = 0.15
FULL_EVERY = 4
"""One step in four is of pictures of the full size, a quarter as many; the others of half the size.
On crops, colours were learnt much more slowly."""
KL_WEIGHT, EDGE_WEIGHT, SQUARE_WEIGHT = 2e-4, 1.0, 2.0


class AutoencoderBatch(NamedTuple):
    images: Float[Tensor, "B 3 s s"]
    noise: Float[Tensor, "B 4 s/8 s/8"]


def autoencoder_batch(
    shards: Shards, index: int, rows: np.ndarray, rng: np.random.Generator
) -> AutoencoderBatch:
    """Draw pictures of full or half the size, some of them of rough Gaussians, and noise."""
    full = rng.random() < 1 / FULL_EVERY
    rows = rows[: max(1, len(rows) // 4)] if full else rows
    shard = shards.get(index)
    rgba = shard.rgba[rows]
    for place in np.flatnonzero(rng.uniform(size=len(rows)) < 0.2):
        rgba[place] = rough_render(shard, int(rows[place]), rng)
    images = with_backgrounds(rgba, rng, random_share=RANDOM_BACKGROUNDS)
    images = images if full else F.avg_pool2d(images, 2)
    side = images.shape[-1] // 8
    noise = normal(rng, (len(rows), models.LATENT_CHANNELS, side, side))
    return AutoencoderBatch(images, noise)


class AutoencoderStage(Stage):
    """Minimise errors of pixels and of their differences, and a small KL divergence."""

    name = "autoencoder"
    batch_size = 8
    learning_rate = 4e-4
    images = 200_000

    def build(self) -> nn.Module:
        return models.autoencoder()

    def frozen(self) -> tuple[str, ...]:
        """Freeze the encoder once the U-Net is trained on its latents; the decoder may improve."""
        trained = is_trained(self.options.folder, "unet")
        return ("encoder.", "quant_conv.") if trained else ()

    def data(self) -> Batches:
        return self.steps(autoencoder_batch)

    def loss(self, model: nn.Module, batch: AutoencoderBatch) -> tuple[Tensor, dict[str, Tensor]]:
        images = batch.images * 2 - 1
        posterior = model.encode(images).latent_dist
        decoded = model.decode(posterior.mean + posterior.std * batch.noise).sample
        error = decoded - images
        # errors of pixels, and of differences between neighbouring ones
        pixels, edges = error.abs().mean(), sum(error.diff(dim=d).abs().mean() for d in (-1, -2))
        kl = posterior.kl().mean() / posterior.mean[0].numel()
        metrics = {"l1": pixels, "edges": edges, "kl": kl}
        loss = pixels + SQUARE_WEIGHT * error.square().mean() + EDGE_WEIGHT * edges
        return loss + KL_WEIGHT * kl, metrics

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Measure the error of pictures, and of the first eight objects as rough Gaussians."""
        shard, errors = self.shards.held_out_shard(), []
        rng = numpy_generator(self.options.seed, "autoencoder-held-out")
        rough = np.stack([rough_render(shard, row, rng) for row in range(8)])
        rgba = np.concatenate([shard.rgba[:64], rough])
        for part in with_backgrounds(rgba, rng, random_share=0).to(self.device).split(8):
            mean = model.encode(part * 2 - 1).latent_dist.mean
            decoded = (model.decode(mean).sample / 2 + 0.5).clamp(0, 1)
            errors.append((decoded - part).square().mean())
        return {"psnr": float(-10 * torch.stack(errors).mean().log10())}


def rough_render(shard: Shard, row: int, rng: np.random.Generator) -> UInt8[np.ndarray, "s s 4"]:
    """Render the object of picture ``row`` as Gaussians at points on its surface, of a random
    number, size, opacity and error of place and colour."""
    views = len(shard.rgba) // len(shard.points)
    points = shard.points[row // views].astype(np.float32)[: int(rng.integers(200, 1000))]
    count = len(points)
    grey = rng.uniform(0, 1)
    colors = grey * 0.5 + (1 - grey) * points[:, 3:]
    colors = (colors + rng.normal(0, 0.1 * rng.uniform(), (count, 3))).clip(0, 1)
    means = points[:, :3] + rng.normal(0, rng.uniform(0, 0.08), (count, 3))
    scales = rng.uniform(0.01, 0.06) * rng.uniform(0.6, 1.6, (count, 3))
    opacities = rng.uniform(0.1, 0.9) * rng.uniform(0.6, 1, count)
    gaussians = means, rng.normal(size=(count, 4)), scales, opacities, colors
    angles = (shard.elevation[row], shard.azimuth[row], np.mean(DISTANCE), math.radians(FOVY_DEG))
    orbit = Orbit(*(torch.tensor([float(value)]) for value in angles))
    (rgba,) = render_gaussians(gaussians, orbit, eps2d=0.3)
    return (rgba * 255).round().astype(np.uint8)
