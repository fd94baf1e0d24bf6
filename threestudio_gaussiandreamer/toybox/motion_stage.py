"""Training a text-to-motion model in MDM's format, on CLIP's text features."""

import functools
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from tqdm import tqdm

from ..core.streams import numpy_generator
from ..diffusion import sds
from ..priors.karras import cosine_alphas_cumprod
from ..priors.text_to_motion import FRAMES, MotionModel
from . import models, motions, words
from .clip_stage import trained_clip
from .loop import Batches, Options, Stage, normal, torch_generator
from .tokens import token_ids

TIMESTEPS, EMPTY_SHARE = 50, 0.1
SUBJECTS = "someone", "someone", "a person", "a man", "a woman"
EACH = 300
"""Motions of each action that a training sees, in random order with fresh sentences."""


class MotionBatch(NamedTuple):
    features: Float[Tensor, "B T 263"]
    """With mean 0 and deviation 1."""
    noise: Float[Tensor, "B T 263"]
    t: Int[Tensor, " B"]
    ids: Int[Tensor, "B 32"]
    empty: Bool[Tensor, " B"]


@functools.cache
def drawn_features(seed: int) -> Float[np.ndarray, "M 60 263"]:
    """Draw :data:`EACH` motions of each action in turn, float32."""
    rng = numpy_generator(seed, "toybox-motion-features")
    drawn = tqdm(motions.names() * EACH, "motions", disable=None)
    return np.stack([motions.features(motions.draw(n, rng, FRAMES + 1).positions) for n in drawn])


def statistics(features: Float[np.ndarray, "M 60 263"]) -> tuple[np.ndarray, np.ndarray]:
    """Return mean and standard deviation, the latter averaged over each kind of feature."""
    std = features.std(axis=(0, 1), dtype=np.float64)
    for kind in np.split(std, (1, 3, 4, 67, 193, 259)):  # where each begins
        kind[:] = kind.mean()
    return features.mean(axis=(0, 1), dtype=np.float64), std


def motion_batch(
    seed: int, batch: int, tokenizer: Any, mean: np.ndarray, std: np.ndarray, step: int
) -> MotionBatch:
    """Draw motions of random actions, sentences about someone, timesteps and noise."""
    rng, found = numpy_generator(seed, "toybox-motions", step), drawn_features(seed)
    rows, names = rng.integers(len(found), size=batch), motions.names()
    features = torch.from_numpy(np.float32((found[rows] - mean) / std))
    texts = [
        f"{SUBJECTS[int(rng.integers(len(SUBJECTS)))]} {words.motion_of(names[i], rng)}"
        for i in rows % len(names)
    ]
    noise = normal(rng, features.shape)
    t = sds.stratified_timesteps(batch, TIMESTEPS, torch_generator(rng))
    empty = torch.from_numpy(rng.uniform(size=batch) < EMPTY_SHARE)
    return MotionBatch(features, noise, t, token_ids(tokenizer, texts), empty)


class MotionStage(Stage):
    """Minimise MDM's own loss: the squared error of the clean features."""

    name = "motion"
    batch_size = 64
    learning_rate = 5e-4
    images = 300_000

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        mean, std = statistics(drawn_features(options.seed))
        self.constants = {"mean": mean.tolist(), "std": std.tolist()}

    def build(self) -> nn.Module:
        self.tokenizer, self.clip = trained_clip(self.options.folder, "text", self.device)
        self.alphas_cumprod = torch.from_numpy(cosine_alphas_cumprod(TIMESTEPS)).to(self.device)
        return self.network()

    @staticmethod
    def network() -> MotionModel:
        sizes = models.MOTION_WIDTH, models.MOTION_LAYERS, models.MOTION_HIDDEN, models.FEATURES
        return MotionModel(*sizes)

    def data(self) -> Batches:
        mean, std = (np.array(self.constants[name]) for name in ("mean", "std"))
        given = self.options.seed, self.batch, self.tokenizer, mean, std
        return functools.partial(motion_batch, *given)

    def loss(self, model: nn.Module, batch: MotionBatch) -> tuple[Tensor, dict[str, Tensor]]:
        text = self.condition(batch.ids) * ~batch.empty[:, None]
        z = sds.diffuse(batch.features, batch.noise, self.alphas_cumprod[batch.t])
        errors = (model(z.float(), batch.t, text) - batch.features).square()
        return errors.mean(), {"places": errors[..., 4:67].mean()}

    def condition(self, ids: Int[Tensor, "B 32"]) -> Float[Tensor, "B D"]:
        """Return CLIP's text features as MDM takes them, of any length."""
        return self.clip.text_projection(self.clip.text_model(input_ids=ids).pooler_output)
