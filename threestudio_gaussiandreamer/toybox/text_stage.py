"""Train the text encoder to recognise an object's attributes in its prompt.

CLIP's image encoder, the U-Net and the points model are trained on its features afterwards
("locked" text, after Zhai et al. 2022). Prompts cost nothing to make and little to encode, so it
sees far more of them than there are pictures, and small encoders learn to associate colours with
parts from classifiers much earlier than from the contrastive loss.
"""

import functools
import re
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.utils.data import Dataset

from ..core.checkpoint_file import entries_below
from ..core.streams import numpy_generator
from . import models, words
from .batches import moved
from .checkpoints import averaged_weights, is_trained
from .classifiers import IGNORED, accuracies, classified
from .loop import Stage
from .text_batches import open_tokenizer, token_ids
from .views import LABELS, label_row, random_angles
from .world import draw_attributes

HELD_OUT = 512
NAMED_QUADRANT = re.compile("(front|back|backside|left side|right side) view")


class TextBatch(NamedTuple):
    ids: Int[Tensor, "B 32"]
    labels: Int[Tensor, "B L"]
    """IGNORED where the prompt doesn't tell the class."""


@dataclass(frozen=True)
class TextData(Dataset):
    """Prompts of random objects; a batch is a function of (seed, step)."""

    seed: int
    batch: int
    tokenizer: Any

    def __getitem__(self, step: int) -> TextBatch:
        return text_batch(self.tokenizer, self.seed, step * self.batch, self.batch)


def text_batch(
    tokenizer: Any, seed: int, start: int, count: int, *, held_out: bool = False
) -> TextBatch:
    """Write the prompts of objects ``start`` to ``start + count``, each from a random view."""
    rng = numpy_generator(seed, "text-batch", start, int(held_out))
    texts, labels = [], []
    for index in range(start, start + count):
        attributes = draw_attributes(seed, index, held_out=held_out)
        elevation, azimuth = random_angles(rng)
        text = words.prompt_of(attributes, elevation, azimuth, rng) or words.describe(
            attributes, rng
        )
        texts.append(text)
        labels.append(torch.from_numpy(label_row(attributes, azimuth)))
    told = torch.tensor([NAMED_QUADRANT.search(text) is not None for text in texts])
    return TextBatch(token_ids(tokenizer, texts), told_labels(torch.stack(labels), told))


class TextStage(Stage):
    """Minimise the cross entropy of linear classifiers on CLIP's text features.

    The classifiers are dropped afterwards.
    """

    name = "text"
    batch_size = 128
    learning_rate = 1e-3
    images = 200_000

    def build(self) -> nn.Module:
        self.tokenizer = open_tokenizer(self.options.folder)
        clip = models.clip_model(len(self.tokenizer))
        parts = {name: getattr(clip, name) for name in TEXT_PARTS}
        return nn.ModuleDict({**parts, "heads": models.AttributeHeads(models.FEATURES)})

    def frozen(self) -> tuple[str, ...]:
        """Freeze the encoder once other networks are trained on it."""
        return TEXT_PARTS if is_trained(self.options.folder, *USERS) else ()

    def data(self) -> TextData:
        return TextData(self.options.seed, self.batch, self.tokenizer)

    def loss(self, model: nn.Module, batch: TextBatch) -> tuple[Tensor, dict[str, Tensor]]:
        loss, right = classified(self._logits(model, batch.ids), batch.labels)
        return loss, {"right": right}

    def _logits(self, model: nn.Module, ids: Tensor) -> dict[str, Tensor]:
        features = text_features(model["text_model"], model["text_projection"], ids)
        return model["heads"](features * features.shape[-1] ** 0.5)

    @functools.cached_property
    def held_out(self) -> TextBatch:
        """Return prompts of withheld combinations, which no training saw."""
        batch = text_batch(self.tokenizer, self.options.seed, 0, HELD_OUT, held_out=True)
        return moved(batch, self.device)

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        return accuracies(self._logits(model, self.held_out.ids), self.held_out.labels)


USERS = ("clip", "unet-small", "unet", "points")
TEXT_PARTS = ("text_model", "text_projection")


def text_features(
    text_model: nn.Module, projection: nn.Module, ids: Int[Tensor, "B 32"]
) -> Float[Tensor, "B D"]:
    """Return the unit features of texts."""
    return F.normalize(projection(text_model(input_ids=ids).pooler_output).float(), dim=-1)


def told_labels(labels: Int[Tensor, "B L"], told: Tensor) -> Int[Tensor, "B L"]:
    """Return the labels with IGNORED in place of directions that a prompt doesn't tell.

    Args:
        told: (B,) bool, whether the prompt names the quadrant.
    """
    labels, quadrant = labels.clone(), list(LABELS).index("quadrant")
    labels[:, quadrant] = torch.where(told, labels[:, quadrant], IGNORED)
    return labels


def with_trained_text(clip: Any, folder: Any) -> Any:
    """Load the trained text encoder's averaged weights into a CLIPModel.

    Raises:
        UserError: it isn't trained.
    """
    weights = averaged_weights(folder, "text")
    for name in TEXT_PARTS:
        getattr(clip, name).load_state_dict(entries_below(weights, f"{name}."))
    return clip


def frozen_text(folder: Any, vocabulary_size: int) -> Any:
    """Return a CLIPModel with the trained text encoder and a random image encoder, no gradients.

    Raises:
        UserError: the text encoder isn't trained.
    """
    clip = with_trained_text(models.clip_model(vocabulary_size), folder)
    return clip.eval().requires_grad_(False)
