"""Training the U-Net on the autoencoder's latents and the text encoder's tokens."""

import functools
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int, UInt8
from torch import Tensor, nn
from torch.utils.data import Dataset
from tqdm import tqdm

from ..core.files import atomic_file
from ..core.streams import generator, numpy_generator
from ..diffusion import sds
from ..models.multiview_unet import views_attended_together
from . import models, words
from .batches import MixedData, StepData, moved, normal, torch_generator
from .checkpoints import averaged_weights, is_trained
from .loop import Stage
from .module_digest import digest
from .sheet import contact_sheet
from .text_batches import (
    joined_prompts,
    open_tokenizer,
    token_ids,
    training_prompts,
    view_prompts,
)
from .text_stage import frozen_text
from .views import SIZE, held_out_shard, is_whole, with_backgrounds

RANDOM_BACKGROUNDS = 0.05
"""Fraction of pictures with a random background. It is small because with a fraction of 0.5 score
distillation produced haze around the object.
"""
SNR_GAMMA = 5.0
LATENT_SCALE = "latent_scale"
TIMESTEPS = models.SCHEDULE["num_train_timesteps"]
HELD_OUT, HELD_OUT_TIMESTEP = 256, 800
SAMPLES, SAMPLE_STEPS, SAMPLE_GUIDANCE = 24, 25, 3.0


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
    """Tokens of the prompts."""
    views: int = 1
    """Number of consecutive pictures whose self-attention is joined."""


@dataclass(frozen=True)
class UNetData(StepData):
    tokenizer: Any
    moments: tuple[Path, ...]
    """The files of the shards' posteriors."""
    stream = "unet"

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> UNetBatch:
        texts = training_prompts(self.shards.get_light(index), rows, rng)
        t = sds.stratified_timesteps(len(rows), TIMESTEPS, torch_generator(rng))
        return self._noised(index, rows, t, texts, rng)

    def _noised(
        self,
        index: int,
        rows: np.ndarray,
        t: Int[Tensor, " B"],
        texts: list[str],
        rng: np.random.Generator,
    ) -> UNetBatch:
        """Draw latents and noise of these pictures of shard ``index``."""
        mean, std = kept_moments(self.moments[index])[:, torch.from_numpy(rows)].float()
        latents = mean + std * normal(rng, mean.shape)
        noise = normal(rng, mean.shape)
        return UNetBatch(latents, noise, t, token_ids(self.tokenizer, texts))


@dataclass(frozen=True)
class JoinedViewsData(UNetData):
    """Batches of objects, all views of each at one timestep."""

    stream = "unet-joined"
    per_object = True

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> UNetBatch:
        views = self.shards.views
        texts = joined_prompts(self.shards.get_light(index), rows, views, rng)
        t = sds.stratified_timesteps(len(rows), TIMESTEPS, torch_generator(rng))
        pictures = (rows[:, None] * views + np.arange(views)).reshape(-1)
        batch = self._noised(index, pictures, t.repeat_interleave(views), texts, rng)
        return batch._replace(views=views)


@functools.lru_cache(maxsize=MOMENTS_IN_MEMORY)
def kept_moments(path: Path) -> Float[Tensor, "2 N 4 s s"]:
    """Read the means and deviations of a shard's posteriors, float16."""
    return torch.load(path, weights_only=True)


class UNetStage(Stage):
    """Train v-prediction with the weights SNR + 1 of Salimans and Ho (2022), where the SNR is
    truncated as in Hang et al. (2023).

    One prompt in ten is empty, for classifier-free guidance. In most steps the self-attention joins
    the views of an object, as in MVDream (Shi et al. 2023, section 3.1), so that their prompts and
    what the views have in common have to tell the directions apart; the weights are the same with
    and without joined views.
    """

    name = "unet"
    batch_size = 64
    learning_rate = 6e-4
    images = 4_000_000
    reduction: ClassVar[int] = 1
    """Factor by which pictures are shrunk."""
    joins_views: ClassVar[bool] = True

    def build(self) -> nn.Module:
        folder = self.options.folder
        self.tokenizer = open_tokenizer(folder)
        self.shards = self.options.shards()
        self.text_model = frozen_text(folder, len(self.tokenizer)).text_model.to(self.device)
        self.vae = frozen_autoencoder(folder).to(self.device)
        self.encoder_digest = digest(self.vae.encoder)
        self.alphas_cumprod = torch.cumprod(1 - models.scheduler().betas.double(), dim=0).to(
            self.device
        )
        self.constants[LATENT_SCALE] = latent_scale(kept_moments(self._moments(0)))
        return self._start(models.unet())

    def _start(self, network: nn.Module) -> nn.Module:
        """Load the weights of the training on small pictures, if there was one."""
        if is_trained(self.options.folder, SmallUNetStage.name):
            weights = averaged_weights(self.options.folder, SmallUNetStage.name)
            network.load_state_dict(weights)
        return network

    @property
    def scale(self) -> float:
        """The factor that scales latents to unit variance."""
        return self.constants[LATENT_SCALE]

    def depends(self) -> dict[str, str]:
        return {"text": digest(self.text_model), "autoencoder": self.encoder_digest}

    def data(self) -> Dataset:
        pool = tqdm(range(self.options.pool), "latents", unit="shard", disable=None)
        moments = tuple(self._moments(index) for index in pool)
        rest = (self.options.pool, self.tokenizer, moments)
        singles = UNetData(self.shards, self.batch, *rest)
        objects = self.batch // self.shards.views
        if not (self.joins_views and objects):
            return singles
        return MixedData(singles, JoinedViewsData(self.shards, objects, *rest), SINGLE_EVERY)

    def loss(self, model: nn.Module, batch: UNetBatch) -> tuple[Tensor, dict[str, Tensor]]:
        abar, errors = self.alphas_cumprod[batch.t], self._errors(model, batch)
        high = abar < 0.1
        metrics = {
            "mse": errors.mean(),
            "mse_high_noise": errors[high].sum() / high.sum().clamp(min=1),
        }
        return (truncated_weight(abar).to(errors) * errors).mean(), metrics

    def _errors(self, model: nn.Module, batch: UNetBatch) -> Float[Tensor, " B"]:
        """Return the squared errors of v."""
        abar, noise, x = self.alphas_cumprod[batch.t], batch.noise, batch.latents * self.scale
        z = sds.add_noise(x, noise, abar)
        v = sds.per_item(abar.sqrt(), x) * noise - sds.per_item((1 - abar).sqrt(), x) * x
        with torch.no_grad():
            tokens = self.text_model(batch.ids).last_hidden_state
        with views_attended_together(model, batch.views):
            predicted = model(z, batch.t, encoder_hidden_states=tokens).sample
        return (predicted.float() - v).square().mean(dim=(1, 2, 3))

    @torch.no_grad()
    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Return the errors of v at a timestep where prompts decide the view, with prompts of the
        pictures' own directions, and of the opposite ones.
        """
        return {name: float(self._errors(model, batch).mean()) for name, batch in self.held_out}

    @functools.cached_property
    def held_out(self) -> list[tuple[str, UNetBatch]]:
        """Return pictures of withheld objects with prompts of their own and of opposite views."""
        shard = held_out_shard(self.options.shards_folder(), self.options.seed)
        rows = np.flatnonzero(shard.elevation < words.OVERHEAD)[:HELD_OUT]
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

    @torch.no_grad()
    def tokens(self, texts: list[str]) -> Float[Tensor, "B 32 W"]:
        """Return the text encoder's last hidden states."""
        return self.text_model(token_ids(self.tokenizer, texts).to(self.device)).last_hidden_state

    def _moments(self, index: int) -> Path:
        """Return the file of a shard's posteriors, which is written on first use: their means and
        deviations (2, N, 4, s, s), float16.
        """
        shard = self.shards.path(index).stem
        name = f"{self.encoder_digest[:12]}-{SIZE // self.reduction}-{shard}.pt"
        path = self.options.folder / "latents" / name
        if not is_whole(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            rgba = self.shards.get(index).rgba
            rng = numpy_generator(self.options.seed, "unet-backgrounds", index)
            moments = self._posteriors(rgba, rng, random_share=RANDOM_BACKGROUNDS)
            with atomic_file(path, durable=False) as file:
                torch.save(moments.half().cpu(), file)
        return path

    @torch.no_grad()
    def _posteriors(
        self, rgba: UInt8[np.ndarray, "N H W 4"], rng: np.random.Generator, *, random_share: float
    ) -> Float[Tensor, "2 N 4 s s"]:
        """Return means and deviations of the posteriors of pictures, composited over backgrounds
        of which this share is random.
        """
        parts = np.array_split(rgba, -(-len(rgba) // ENCODED_AT_ONCE))
        images = (with_backgrounds(part, rng, random_share=random_share) for part in parts)
        posteriors = [
            self.vae.encode(self._shrunk(part.to(self.device)) * 2 - 1).latent_dist
            for part in images
        ]
        return torch.stack(
            [torch.cat([getattr(p, name) for p in posteriors]) for name in ("mean", "std")]
        )

    def _shrunk(self, images: Float[Tensor, "B 3 128 128"]) -> Float[Tensor, "B 3 s s"]:
        return F.avg_pool2d(images, self.reduction) if self.reduction > 1 else images

    @functools.cached_property
    def sheet_prompts(self) -> list[str]:
        """Write prompts of withheld objects, which no training saw."""
        shard = held_out_shard(self.options.shards_folder(), self.options.seed)
        rows = np.arange(SAMPLES) * 5 % len(shard.rgba)  # other views of other objects
        return view_prompts(shard, rows, numpy_generator(self.options.seed, "unet-sheet"))

    def sheet(self, model: nn.Module) -> np.ndarray:
        texts, side = self.sheet_prompts, SIZE // 8 // self.reduction
        noise = torch.randn(
            (len(texts), models.LATENT_CHANNELS, side, side),
            generator=generator(self.options.seed, "unet-sheet"),
        ).to(self.device)
        latents = self.sample(model, noise, texts, guidance=SAMPLE_GUIDANCE)
        return contact_sheet(
            (self.vae.decode(latents / self.scale).sample / 2 + 0.5), texts, columns=8
        )

    @torch.no_grad()
    def sample(
        self, model: nn.Module, noise: Tensor, texts: list[str], *, guidance: float
    ) -> Float[Tensor, "B 4 s s"]:
        """Sample latents of unit variance for the texts by DDIM."""
        tokens = torch.cat([self.tokens(texts), self.tokens([""] * len(texts))])
        abar = self.alphas_cumprod

        def eps(z: Tensor, t: Int[Tensor, " B"]) -> Tensor:
            v = model(torch.cat([z, z]), torch.cat([t, t]), encoder_hidden_states=tokens).sample
            noises = [
                sds.per_item(abar[t].sqrt(), z) * half + sds.per_item((1 - abar[t]).sqrt(), z) * z
                for half in v.chunk(2)
            ]
            return sds.classifier_free(*noises, guidance)

        t = torch.full((len(noise),), len(abar) - 1, device=self.device)
        return sds.ddim_sample(eps, noise, t, abar, steps=SAMPLE_STEPS)


class SmallUNetStage(UNetStage):
    """Train the U-Net on pictures of half the size first, at a quarter of the cost per picture."""

    name = "unet-small"
    images = 4_000_000
    reduction = 2
    joins_views = False

    def _start(self, network: nn.Module) -> nn.Module:
        return network


def truncated_weight(abar: Float[Tensor, " B"]) -> Float[Tensor, " B"]:
    """Return the weight of v's squared error, (min(SNR, gamma) + 1) / (SNR + 1).

    That of the picture's error is min(SNR, gamma) + 1. It doesn't fall to 0 with the SNR as
    min(SNR, gamma) does, so that high noise levels keep their weight: only there does the prompt
    decide between left and right.
    """
    snr = abar / (1 - abar)
    return (snr.clamp(max=SNR_GAMMA) + 1) / (snr + 1)


def latent_scale(moments: Float[Tensor, "2 N 4 h w"]) -> float:
    """Return the factor that brings latents to unit variance."""
    mean, std = moments.double()
    return float((mean.var() + std.square().mean()) ** -0.5)


def frozen_autoencoder(folder: Any) -> nn.Module:
    """Load the trained autoencoder's averaged weights, without gradients.

    Raises:
        UserError: it isn't trained.
    """
    vae = models.autoencoder()
    vae.load_state_dict(averaged_weights(folder, "autoencoder"))
    return vae.eval().requires_grad_(False)
