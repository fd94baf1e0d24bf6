"""Training the U-Net on the autoencoder's latents and the text encoder's tokens."""

import functools
import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from tqdm import tqdm

from ..core.files import atomic_file
from ..core.streams import generator, numpy_generator
from ..diffusion import sds
from ..models.multiview_unet import views_attended_together
from ..prompts.view_prompts import THRESHOLDS
from . import models
from .clip_stage import trained_clip
from .loop import Batches, Stage, averaged_weights, mixed_batch, moved, normal, torch_generator
from .tokens import joined_prompts, token_ids, training_prompts, view_prompts
from .views import SIZE, Shards, with_backgrounds

RANDOM_BACKGROUNDS = 0.05
"""Of the pictures; with 0.5 score distillation produced haze around the object."""
SNR_GAMMA = 5.0
LATENT_SCALE = "latent_scale"
TIMESTEPS = models.SCHEDULE["num_train_timesteps"]
HELD_OUT, HELD_OUT_TIMESTEP = 256, 800
SINGLE_EVERY = 4
"""One step in so many is of single pictures, the others of objects with joined views."""
ENCODED_AT_ONCE = 64
MOMENTS_IN_MEMORY = 256
"""Number of shards whose latents a process keeps in memory, 4 MB each."""


class UNetBatch(NamedTuple):
    latents: Float[Tensor, "B 4 s s"]
    """Drawn from the autoencoder's posteriors, not scaled."""
    noise: Float[Tensor, "B 4 s s"]
    t: Int[Tensor, " B"]
    ids: Int[Tensor, "B 32"]
    views: int = 1
    """Number of consecutive pictures whose self-attention is joined."""


def unet_batch(
    shards: Shards,
    tokenizer: Any,
    moments: Sequence[Path],
    views: int,
    index: int,
    rows: np.ndarray,
    rng: np.random.Generator,
) -> UNetBatch:
    """Draw a prompt, latents and noise for each of these pictures, and a timestep; with ``views``
    above 1, rows are objects, whose views have one timestep. ``moments``: the shards' files."""
    if views == 1:
        texts = training_prompts(shards.get(index), rows, rng)
    else:
        texts = joined_prompts(shards.get(index), rows, views, rng)
        rows = (rows[:, None] * views + np.arange(views)).reshape(-1)
    t = sds.stratified_timesteps(len(rows) // views, TIMESTEPS, torch_generator(rng))
    mean, std = kept_moments(moments[index])[:, torch.from_numpy(rows)].float()
    latents = mean + std * normal(rng, mean.shape)
    noise = normal(rng, mean.shape)
    return UNetBatch(latents, noise, t.repeat_interleave(views), token_ids(tokenizer, texts), views)


@functools.lru_cache(maxsize=MOMENTS_IN_MEMORY)
def kept_moments(path: Path) -> Float[Tensor, "2 N 4 s s"]:
    """Read the means and deviations of a shard's posteriors, float16."""
    return torch.load(path, weights_only=True)


class UNetStage(Stage):
    """Train v-prediction with the weights SNR + 1 of Salimans and Ho (2022), truncated as in Hang
    et al. (2023). Most steps join the self-attention of an object's views, as in MVDream (Shi et
    al. 2023), so that their prompts have to tell the directions apart."""

    name = "unet"
    batch_size = 64
    learning_rate = 6e-4
    images = 5_000_000

    def build(self) -> nn.Module:
        folder = self.options.folder
        self.tokenizer, clip = trained_clip(folder, "text", self.device)
        self.text_model = clip.text_model
        self.vae = frozen_autoencoder(folder).to(self.device)
        encoder = sorted(self.vae.encoder.state_dict().items())
        content = (name.encode() + v.cpu().contiguous().numpy().tobytes() for name, v in encoder)
        self.encoder_digest = hashlib.sha256(b"".join(content)).hexdigest()
        betas = models.scheduler().betas.double()
        self.alphas_cumprod = torch.cumprod(1 - betas, dim=0).to(self.device)
        self.constants[LATENT_SCALE] = latent_scale(kept_moments(self._moments(0)))
        # 1.7 times faster in bfloat16 on a CPU
        return models.unet().to(memory_format=torch.channels_last)

    def data(self) -> Batches:
        pool = tqdm(range(self.options.pool), "latents", unit="shard", disable=None)
        given = self.tokenizer, [self._moments(index) for index in pool]
        singles, views = self.steps(unet_batch, *given, 1), self.shards.views
        objects = {"batch": self.batch // views, "stream": "unet-joined", "per_object": True}
        if self.batch < views:
            return singles
        joined = self.steps(unet_batch, *given, views, **objects)
        return functools.partial(mixed_batch, singles, joined, SINGLE_EVERY)

    def loss(self, model: nn.Module, batch: UNetBatch) -> tuple[Tensor, dict[str, Tensor]]:
        abar, errors = self.alphas_cumprod[batch.t], self._errors(model, batch)
        high = abar < 0.1
        at_high_noise = errors[high].sum() / high.sum().clamp(min=1)
        metrics = {"mse": errors.mean(), "mse_high_noise": at_high_noise}
        return (truncated_weight(abar).to(errors) * errors).mean(), metrics

    def _errors(self, model: nn.Module, batch: UNetBatch) -> Float[Tensor, " B"]:
        """Return the squared errors of v."""
        abar, noise = self.alphas_cumprod[batch.t], batch.noise
        x = batch.latents * self.constants[LATENT_SCALE]
        z = sds.diffuse(x, noise, abar).contiguous(memory_format=torch.channels_last)
        v = sds.per_item(abar.sqrt(), x) * noise - sds.per_item((1 - abar).sqrt(), x) * x
        tokens = self.text_model(batch.ids).last_hidden_state
        with views_attended_together(model, batch.views):
            predicted = model(z, batch.t, encoder_hidden_states=tokens).sample
        return (predicted.float() - v).square().mean(dim=(1, 2, 3))

    @torch.no_grad()
    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Return the errors of v where prompts decide the view, with own and opposite prompts."""
        return {name: float(self._errors(model, batch).mean()) for name, batch in self.held_out()}

    def held_out(self) -> list[tuple[str, UNetBatch]]:
        """Return pictures of withheld objects with prompts of their own and of opposite views."""
        shard = self.shards.held_out_shard()
        rows = np.flatnonzero(shard.elevation < THRESHOLDS["overhead_threshold"])[:HELD_OUT]
        rng = numpy_generator(self.options.seed, "unet-held-out")
        latents = self._posteriors(shard.rgba[rows], rng, random_share=0)[0].cpu()
        noise = torch.randn(latents.shape, generator=generator(self.options.seed, "unet-held-out"))
        t = torch.full((len(rows),), HELD_OUT_TIMESTEP)
        found = []
        for suffix, opposite in (("", False), ("_opposite_view", True)):
            rng = numpy_generator(self.options.seed, "unet-held-out-prompts")
            ids = token_ids(self.tokenizer, view_prompts(shard, rows, rng, opposite=opposite))
            batch = moved(UNetBatch(latents, noise, t, ids), self.device)
            found.append((f"mse_at_{HELD_OUT_TIMESTEP}{suffix}", batch))
        return found

    def _moments(self, index: int) -> Path:
        """Return the file of a shard's posteriors, float16, which is written on first use."""
        name = f"{self.encoder_digest[:12]}-{SIZE}-{self.shards.path(index).stem}.pt"
        path = self.options.folder / "latents" / name
        if not path.is_file():
            path.parent.mkdir(parents=True, exist_ok=True)
            rgba = self.shards.get(index).rgba
            rng = numpy_generator(self.options.seed, "unet-backgrounds", index)
            moments = self._posteriors(rgba, rng, random_share=RANDOM_BACKGROUNDS)
            with atomic_file(path) as file:
                torch.save(moments.half().cpu(), file)
        return path

    @torch.no_grad()
    def _posteriors(
        self, rgba: UInt8[np.ndarray, "N H W 4"], rng: np.random.Generator, *, random_share: float
    ) -> Float[Tensor, "2 N 4 s s"]:
        """Return means and deviations of the posteriors of pictures over backgrounds."""
        found = []
        for part in np.array_split(rgba, -(-len(rgba) // ENCODED_AT_ONCE)):
            images = with_backgrounds(part, rng, random_share=random_share).to(self.device)
            posterior = self.vae.encode(images * 2 - 1).latent_dist
            found.append(torch.stack([posterior.mean, posterior.std]))
        return torch.cat(found, dim=1)


def truncated_weight(abar: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the weight of v's squared error, (min(SNR, gamma) + 1) / (SNR + 1): whole at high
    noise, where the prompt decides between left and right."""
    snr = abar / (1 - abar)
    return (snr.clamp(max=SNR_GAMMA) + 1) / (snr + 1)


def latent_scale(moments: Float[Tensor, "2 N 4 h w"]) -> float:
    """Return the factor that brings latents to unit variance."""
    mean, std = moments.double()
    return float((mean.var() + std.square().mean()) ** -0.5)


def frozen_autoencoder(folder: Any) -> nn.Module:
    """Load the trained autoencoder's averaged weights, without gradients."""
    vae = models.autoencoder()
    vae.load_state_dict(averaged_weights(folder, "autoencoder"))
    return vae.eval().requires_grad_(False)
