"""Training CLIP on pictures and prompts, with classifiers of the attributes beside it."""

import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.streams import numpy_generator
from ..models.clip import MEAN, STD
from . import models
from .batches import StepData, batches
from .loop import Stage, checkpoint_path
from .text_batches import label_tensor, open_tokenizer, token_ids, training_prompts, view_prompts
from .views import LABELS, VIEWS, Shards, held_out_shard, with_backgrounds

RANDOM_BACKGROUNDS = 0.3
LARGEST_SCALE = 100.0


class ClipBatch(NamedTuple):
    pixels: Float[Tensor, "B 3 s s"]
    """As CLIP takes them."""
    ids: Int[Tensor, "B 32"]
    labels: Int[Tensor, "B L"]
    has_text: Tensor
    """(B,) bool: false for empty prompts."""
    has_view: Tensor
    """(B,) bool: whether the prompt names the direction."""


@dataclass(frozen=True)
class ClipData(StepData):
    tokenizer: Any
    stream = "clip"

    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> ClipBatch:
        shard = self.shards.get(index)
        texts = training_prompts(shard, rows, rng)
        images = with_backgrounds(shard.rgba[rows], rng, random_share=RANDOM_BACKGROUNDS)
        return ClipBatch(
            clip_pixels(images),
            token_ids(self.tokenizer, texts),
            label_tensor(shard, rows),
            torch.tensor([bool(text) for text in texts]),
            torch.tensor(["view" in text for text in texts]),
        )


class ClipStage(Stage):
    """Minimise CLIP's contrastive loss (Radford et al. 2021) and that of attribute classifiers.

    The classifiers are dropped afterwards. With them, small encoders learn to associate colours
    with parts much earlier than with the contrastive loss alone.
    """

    name = "clip"
    batch_size = 128
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.tokenizer = open_tokenizer(self.options.folder)
        self.shards = Shards(
            self.options.shards_folder(), self.options.seed, objects=self.options.shard_objects
        )
        width = models.FEATURES
        heads = {
            "image_heads": models.AttributeHeads(width),
            "text_heads": models.AttributeHeads(width),
        }
        return nn.ModuleDict({"clip": models.clip_model(len(self.tokenizer)), **heads})

    def frozen(self) -> tuple[str, ...]:
        """Freeze the text tower once other networks are trained on it."""
        users = (checkpoint_path(self.options.folder, name) for name in ("unet", "points"))
        trained = any(path.exists() for path in users)
        return ("clip.text_model.", "clip.text_projection.") if trained else ()

    def batches(self, step: int) -> Iterator[ClipBatch]:
        data = ClipData(self.options, self.shards, self.batch, self.tokenizer)
        return batches(data, step, self.device, self.options.workers)

    def loss(self, model: nn.Module, batch: ClipBatch) -> tuple[Tensor, dict[str, Tensor]]:
        text, image = clip_features(model["clip"], batch.ids, batch.pixels)
        contrast = contrastive(
            text[batch.has_text], image[batch.has_text], model["clip"].logit_scale
        )
        width = text.shape[-1] ** 0.5
        image_loss, image_right = classified(model["image_heads"](image * width), batch.labels)
        text_loss, text_right = classified(
            model["text_heads"](text[batch.has_text] * width), text_labels(batch)
        )
        metrics = {"contrast": contrast, "image_right": image_right, "text_right": text_right}
        return contrast + image_loss + text_loss, metrics

    @functools.cached_property
    def held_out(self) -> ClipBatch:
        """Return withheld objects with prompts that name the direction."""
        shard = held_out_shard(self.options.shards_folder(), self.options.seed)
        rows = np.arange(len(shard.rgba))
        rng = numpy_generator(self.options.seed, "clip-held-out")
        ids = token_ids(self.tokenizer, view_prompts(shard, rows, rng))
        pixels = clip_pixels(with_backgrounds(shard.rgba, rng, random_share=0))
        yes = torch.ones(len(rows), dtype=torch.bool)
        return ClipBatch(
            *(value.to(self.device) for value in (pixels, ids, label_tensor(shard, rows), yes, yes))
        )

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        batch = self.held_out
        text, image = clip_features(model["clip"], batch.ids, batch.pixels)
        objects = torch.arange(len(text), device=text.device) // VIEWS
        match = objects[(text @ image.T).argmax(dim=1)] == objects
        width = text.shape[-1] ** 0.5
        rights = accuracies(model["image_heads"](image * width), batch.labels)
        texts = accuracies(model["text_heads"](text * width), text_labels(batch))
        named = [("image", name, value) for name, value in rights.items()]
        named += [("text", name, value) for name, value in texts.items()]
        found = {f"{tower}_{name}": value for tower, name, value in named}
        return {"text_finds_object": float(match.float().mean()), **found}


def clip_pixels(images: Float[Tensor, "B 3 s s"]) -> Float[Tensor, "B 3 s s"]:
    """Normalise pictures in [0, 1] as CLIP expects them."""
    return (images - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


def clip_features(
    clip: Any, ids: Tensor, pixels: Tensor
) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
    """Return the unit features of texts and of pictures."""
    text = clip.text_projection(clip.text_model(input_ids=ids).pooler_output)
    image = clip.visual_projection(clip.vision_model(pixel_values=pixels).pooler_output)
    return F.normalize(text.float(), dim=-1), F.normalize(image.float(), dim=-1)


def contrastive(
    text: Float[Tensor, "B D"], image: Float[Tensor, "B D"], log_scale: Tensor
) -> Tensor:
    """Return the mean cross entropy of matching texts and pictures within the batch."""
    logits = log_scale.exp().clamp(max=LARGEST_SCALE) * text @ image.T
    target = torch.arange(len(text), device=text.device)
    return (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target)) / 2


IGNORED = -100
"""The label of classes that losses ignore."""


def text_labels(batch: ClipBatch) -> Int[Tensor, "T L"]:
    """Return the labels of the non-empty prompts; classes that a prompt doesn't name are ignored.

    Those are directions that it leaves out, and left and right, which it can't tell apart.
    """
    labels = batch.labels[batch.has_text].clone()
    quadrant = list(LABELS).index("quadrant")
    unknown = ~batch.has_view[batch.has_text] | (labels[:, quadrant] % 2 == 1)
    labels[:, quadrant] = torch.where(unknown, IGNORED, labels[:, quadrant])
    return labels


def classified(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> tuple[Tensor, Tensor]:
    """Return the mean cross entropy over the attributes, and the share recognised."""
    pairs = list(zip(logits.values(), labels.unbind(1), strict=True))
    sums = [_summed_error(value.float(), label) for value, label in pairs]
    known = (labels != IGNORED).sum(dim=0).clamp(min=1)  # a batch may have no label of a column
    loss = (torch.stack(sums) / known).mean()
    right = torch.stack([(value.argmax(-1) == label).sum() for value, label in pairs]).sum()
    return loss, right / known.sum()


def _summed_error(logits: Float[Tensor, "B C"], label: Int[Tensor, " B"]) -> Tensor:
    return F.cross_entropy(logits, label, ignore_index=IGNORED, reduction="sum")


def accuracies(logits: dict[str, Tensor], labels: Int[Tensor, "B L"]) -> dict[str, float]:
    """Return the share recognised of each attribute."""
    out = {}
    for (name, value), label in zip(logits.items(), labels.unbind(1), strict=True):
        known = label != IGNORED
        out[name] = float((value.argmax(-1)[known] == label[known]).float().mean())
    return out
