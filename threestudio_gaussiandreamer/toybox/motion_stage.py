"""Training a text-to-motion model in MDM's format, on CLIP's text features."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.utils.data import Dataset

from ..core.streams import numpy_generator
from ..diffusion import sds
from ..priors.karras import cosine_alphas_cumprod
from ..priors.text_to_motion import FRAMES, MotionModel
from . import models, motions, words
from .clip_stage import trained_clip
from .loop import Options, Stage, normal, torch_generator
from .tokens import open_tokenizer, token_ids

TIMESTEPS, EMPTY_SHARE = 50, 0.1
SUBJECTS = "someone", "someone", "a person", "a man", "a woman"
MEASURED = 40
"""Motions of each action from which the features' mean and deviation are computed."""


class MotionBatch(NamedTuple):
    features: Float[Tensor, "B T 263"]
    """With mean 0 and deviation 1."""
    noise: Float[Tensor, "B T 263"]
    t: Int[Tensor, " B"]
    ids: Int[Tensor, "B 32"]
    empty: Bool[Tensor, " B"]


@functools.cache
def statistics(seed: int) -> tuple[Float[np.ndarray, "263"], Float[np.ndarray, "263"]]:
    """Return mean and standard deviation of the features, the latter averaged over each kind of
    feature, as HumanML3D's.
    """
    rng = numpy_generator(seed, "toybox-motion-statistics")
    drawn = [motions.draw(name, rng, FRAMES + 1) for name in motions.names() * MEASURED]
    features = np.concatenate([motions.features(motion.positions) for motion in drawn])
    std = features.std(axis=0)
    for start, end in zip(KINDS, KINDS[1:], strict=False):
        std[start:end] = std[start:end].mean()
    return features.mean(axis=0), std


KINDS = (0, 1, 3, 4, 67, 193, 259, 263)
"""Where each kind of feature begins."""


def sentence(action: str, rng: np.random.Generator) -> str:
    """Write a sentence about someone."""
    return f"{SUBJECTS[int(rng.integers(len(SUBJECTS)))]} {words.motion_of(action, rng)}"


@dataclass(frozen=True)
class MotionData(Dataset):
    """Motions of random actions; a batch is a function of (seed, step)."""

    seed: int
    batch: int
    tokenizer: Any

    def __getitem__(self, step: int) -> MotionBatch:
        rng = numpy_generator(self.seed, "toybox-motions", step)
        names = [str(name) for name in rng.choice(motions.names(), self.batch)]
        found = [motions.features(motions.draw(n, rng, FRAMES + 1).positions) for n in names]
        mean, std = statistics(self.seed)
        features = torch.from_numpy(((np.stack(found) - mean) / std).astype(np.float32))
        return MotionBatch(
            features,
            normal(rng, features.shape),
            sds.stratified_timesteps(self.batch, TIMESTEPS, torch_generator(rng)),
            token_ids(self.tokenizer, [sentence(name, rng) for name in names]),
            torch.from_numpy(rng.uniform(size=self.batch) < EMPTY_SHARE),
        )


class MotionStage(Stage):
    """Minimise MDM's own loss: the squared error of the clean features."""

    name = "motion"
    batch_size = 64
    learning_rate = 5e-4
    images = 300_000

    def __init__(self, options: Options) -> None:
        super().__init__(options)
        mean, std = statistics(options.seed)
        self.constants = {"mean": mean.tolist(), "std": std.tolist()}

    def build(self) -> nn.Module:
        self.tokenizer = open_tokenizer(self.options.folder)
        self.clip = trained_clip(self.options.folder, len(self.tokenizer), "text").to(self.device)
        self.alphas_cumprod = torch.from_numpy(cosine_alphas_cumprod(TIMESTEPS)).to(self.device)
        return self.network()

    @staticmethod
    def network() -> MotionModel:
        sizes = models.MOTION_WIDTH, models.MOTION_LAYERS, models.MOTION_HIDDEN, models.FEATURES
        return MotionModel(*sizes)

    def data(self) -> MotionData:
        return MotionData(self.options.seed, self.batch, self.tokenizer)

    def loss(self, model: nn.Module, batch: MotionBatch) -> tuple[Tensor, dict[str, Tensor]]:
        text = self.condition(batch.ids) * ~batch.empty[:, None]
        z = sds.diffuse(batch.features, batch.noise, self.alphas_cumprod[batch.t])
        errors = (model(z.float(), batch.t, text) - batch.features).square()
        places = errors[..., 4:67].mean()
        return errors.mean(), {"places": places}

    @torch.no_grad()
    def condition(self, ids: Int[Tensor, "B 32"]) -> Float[Tensor, "B D"]:
        """Return CLIP's text features as MDM takes them, of any length."""
        return self.clip.text_projection(self.clip.text_model(input_ids=ids).pooler_output)
