"""Train CLIP: first the text encoder, to recognise an object's attributes in its prompt, then the
image encoder, on the fixed features of the trained text encoder (after Zhai et al. 2022).

Classifiers teach small encoders which colour belongs to which part, much earlier than contrast."""

import re
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from ..core.checkpoint_file import entries_below
from ..core.streams import numpy_generator
from ..models.clip import normalized
from . import models, words
from .loop import Batches, Stage, averaged_weights, is_trained, moved
from .models import IGNORED, accuracies, classified
from .tokens import open_tokenizer, token_ids, training_prompts, view_prompts
from .views import LABELS, VIEWS, Shards, draw_orbit, label_row, with_backgrounds
from .world import draw_attributes

HELD_OUT = 512
NAMED_QUADRANT = re.compile("(front|back|backside|left side|right side) view")


class TextBatch(NamedTuple):
    ids: Int[Tensor, "B 32"]
    labels: Int[Tensor, "B L"]
    """IGNORED where the prompt doesn't tell the class."""


def text_batch(seed: int, batch: int, tokenizer: Any, held_out: bool, step: int) -> TextBatch:
    """Draw prompts of objects from random views."""
    start, texts, labels = step * batch, [], []
    rng = numpy_generator(seed, "text-batch", start, int(held_out))
    for index in range(start, start + batch):
        attributes = draw_attributes(seed, index, held_out=held_out)
        elevation, azimuth = map(float, draw_orbit(1, rng)[:2])
        text = words.prompt_of(attributes, elevation, azimuth, rng)
        texts.append(text or words.describe(attributes, rng))
        labels.append(label_row(attributes, azimuth))
        if not NAMED_QUADRANT.search(texts[-1]):
            labels[-1][list(LABELS).index("quadrant")] = IGNORED
    return TextBatch(token_ids(tokenizer, texts), torch.from_numpy(np.stack(labels)))


class TextStage(Stage):
    """Minimise the cross entropy of linear classifiers on CLIP's text features."""

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
        trained = is_trained(self.options.folder, "clip", "unet", "points", "motion")
        return TEXT_PARTS if trained else ()

    def data(self) -> Batches:
        return partial(text_batch, self.options.seed, self.batch, self.tokenizer, False)

    def loss(self, model: nn.Module, batch: TextBatch) -> tuple[Tensor, dict[str, Tensor]]:
        loss, right = classified(self._logits(model, batch.ids), batch.labels)
        return loss, {"right": right}

    def _logits(self, model: nn.Module, ids: Tensor) -> dict[str, Tensor]:
        features = text_features(model["text_model"], model["text_projection"], ids)
        return model["heads"](features * features.shape[-1] ** 0.5)

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        batch = moved(text_batch(self.options.seed, HELD_OUT, self.tokenizer, True, 0), self.device)
        return accuracies(self._logits(model, batch.ids), batch.labels)


TEXT_PARTS = ("text_model", "text_projection")


def text_features(
    text_model: nn.Module, projection: nn.Module, ids: Int[Tensor, "B 32"]
) -> Float[Tensor, "B D"]:
    """Return the unit features of texts."""
    return F.normalize(projection(text_model(input_ids=ids).pooler_output).float(), dim=-1)


def trained_clip(folder: Path, stage: str, device: Any = "cpu") -> tuple[Any, Any]:
    """Return the tokenizer, and a frozen CLIPModel of a stage's averaged weights; after "text" its
    image encoder is random."""
    tokenizer = open_tokenizer(folder)
    clip, weights = models.clip_model(len(tokenizer)), averaged_weights(folder, stage)
    whole = stage == ClipStage.name
    clip.load_state_dict(entries_below(weights, "clip.") if whole else weights, strict=whole)
    return tokenizer, clip.eval().requires_grad_(False).to(device)


RANDOM_BACKGROUNDS = 0.3
LARGEST_SCALE = 100.0


class ClipBatch(NamedTuple):
    pixels: Float[Tensor, "B 3 s s"]
    """As CLIP takes them."""
    ids: Int[Tensor, "B 32"]
    labels: Int[Tensor, "B L"]
    has_text: Bool[Tensor, " B"]


def clip_batch(
    shards: Shards, tokenizer: Any, index: int, rows: np.ndarray, rng: np.random.Generator
) -> ClipBatch:
    """Draw a background and a prompt for each of these pictures."""
    shard = shards.get(index)
    texts = training_prompts(shard, rows, rng)
    images = with_backgrounds(shard.rgba[rows], rng, random_share=RANDOM_BACKGROUNDS)
    labels, has_text = torch.from_numpy(shard.labels[rows]), torch.tensor([*map(bool, texts)])
    return ClipBatch(normalized(images), token_ids(tokenizer, texts), labels, has_text)


class ClipStage(Stage):
    """Minimise CLIP's contrastive loss (Radford et al. 2021) and that of attribute classifiers."""

    name = "clip"
    batch_size = 128
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.tokenizer, clip = trained_clip(self.options.folder, "text")
        heads = models.AttributeHeads(models.FEATURES)
        return nn.ModuleDict({"clip": clip, "image_heads": heads}).train().requires_grad_(True)

    def frozen(self) -> tuple[str, ...]:
        return tuple(f"clip.{name}" for name in TEXT_PARTS)

    def data(self) -> Batches:
        return self.steps(clip_batch, self.tokenizer)

    def loss(self, model: nn.Module, batch: ClipBatch) -> tuple[Tensor, dict[str, Tensor]]:
        text, image = clip_features(model["clip"], batch.ids, batch.pixels)
        told = batch.has_text
        scale = model["clip"].logit_scale.exp().clamp(max=LARGEST_SCALE)
        matches = scale * text[told] @ image[told].T
        target = torch.arange(len(matches), device=text.device)
        contrast = (F.cross_entropy(matches, target) + F.cross_entropy(matches.T, target)) / 2
        logits = model["image_heads"](image * text.shape[-1] ** 0.5)
        loss, right = classified(logits, batch.labels)
        return contrast + loss, {"contrast": contrast, "right": right}

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Measure on withheld objects with prompts that name the direction."""
        shard = self.shards.held_out_shard()
        rng = numpy_generator(self.options.seed, "clip-held-out")
        texts = view_prompts(shard, np.arange(len(shard.rgba)), rng)
        pixels = normalized(with_backgrounds(shard.rgba, rng, random_share=0)).to(self.device)
        ids = token_ids(self.tokenizer, texts).to(self.device)
        text, image = clip_features(model["clip"], ids, pixels)
        objects = torch.arange(len(text), device=text.device) // VIEWS
        match = objects[(text @ image.T).argmax(dim=1)] == objects
        labels = torch.from_numpy(shard.labels).to(self.device)
        rights = accuracies(model["image_heads"](image * text.shape[-1] ** 0.5), labels)
        return {"text_finds_object": float(match.float().mean()), **rights}


def clip_features(
    clip: Any, ids: Tensor, pixels: Tensor
) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
    """Return the unit features of texts and of pictures."""
    image = clip.visual_projection(clip.vision_model(pixel_values=pixels).pooler_output)
    text = text_features(clip.text_model, clip.text_projection, ids)
    return text, F.normalize(image.float(), dim=-1)
