"""Train CLIP's image encoder on the features of the trained text encoder, which stay fixed."""

import functools
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Int
from torch import Tensor, nn

from ..core.checkpoint_file import entries_below
from ..core.streams import numpy_generator
from ..models.clip import MEAN, STD
from . import models
from .batches import StepData, moved
from .checkpoints import averaged_weights
from .classifiers import accuracies, classified
from .loop import Stage
from .module_digest import digest
from .text_batches import label_tensor, open_tokenizer, token_ids, training_prompts, view_prompts
from .text_stage import TEXT_PARTS, text_features, with_trained_text
from .views import VIEWS, held_out_shard, with_backgrounds

RANDOM_BACKGROUNDS = 0.3
LARGEST_SCALE = 100.0


class ClipBatch(NamedTuple):
    pixels: Float[Tensor, "B 3 s s"]
    """As CLIP takes them."""
    ids: Int[Tensor, "B 32"]
    labels: Int[Tensor, "B L"]
    has_text: Tensor
    """(B,) bool: false for empty prompts."""


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
        )


class ClipStage(Stage):
    """Minimise CLIP's contrastive loss (Radford et al. 2021) and that of attribute classifiers.

    The classifiers are dropped afterwards.
    """

    name = "clip"
    batch_size = 128
    learning_rate = 1e-3
    images = 400_000

    def build(self) -> nn.Module:
        self.tokenizer = open_tokenizer(self.options.folder)
        self.shards = self.options.shards()
        clip = with_trained_text(models.clip_model(len(self.tokenizer)), self.options.folder)
        self.text_digest = digest(clip.text_model)
        heads = models.AttributeHeads(models.FEATURES)
        return nn.ModuleDict({"clip": clip, "image_heads": heads})

    def frozen(self) -> tuple[str, ...]:
        return tuple(f"clip.{name}" for name in TEXT_PARTS)

    def depends(self) -> dict[str, str]:
        return {"text": self.text_digest}

    def data(self) -> ClipData:
        return ClipData(self.shards, self.batch, self.options.pool, self.tokenizer)

    def loss(self, model: nn.Module, batch: ClipBatch) -> tuple[Tensor, dict[str, Tensor]]:
        text, image = clip_features(model["clip"], batch.ids, batch.pixels)
        contrast = contrastive(
            text[batch.has_text], image[batch.has_text], model["clip"].logit_scale
        )
        logits = model["image_heads"](image * text.shape[-1] ** 0.5)
        loss, right = classified(logits, batch.labels)
        return contrast + loss, {"contrast": contrast, "right": right}

    @functools.cached_property
    def held_out(self) -> ClipBatch:
        """Return withheld objects with prompts that name the direction."""
        shard = held_out_shard(self.options.shards_folder(), self.options.seed)
        rows = np.arange(len(shard.rgba))
        rng = numpy_generator(self.options.seed, "clip-held-out")
        ids = token_ids(self.tokenizer, view_prompts(shard, rows, rng))
        pixels = clip_pixels(with_backgrounds(shard.rgba, rng, random_share=0))
        has_text = torch.ones(len(rows), dtype=torch.bool)
        return moved(ClipBatch(pixels, ids, label_tensor(shard, rows), has_text), self.device)

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        batch = self.held_out
        text, image = clip_features(model["clip"], batch.ids, batch.pixels)
        objects = torch.arange(len(text), device=text.device) // VIEWS
        match = objects[(text @ image.T).argmax(dim=1)] == objects
        rights = accuracies(model["image_heads"](image * text.shape[-1] ** 0.5), batch.labels)
        return {"text_finds_object": float(match.float().mean()), **rights}


def clip_pixels(images: Float[Tensor, "B 3 s s"]) -> Float[Tensor, "B 3 s s"]:
    """Normalise pictures in [0, 1] as CLIP expects them."""
    return (images - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]


def clip_features(
    clip: Any, ids: Tensor, pixels: Tensor
) -> tuple[Float[Tensor, "B D"], Float[Tensor, "B D"]]:
    """Return the unit features of texts and of pictures."""
    image = clip.visual_projection(clip.vision_model(pixel_values=pixels).pooler_output)
    text = text_features(clip.text_model, clip.text_projection, ids)
    return text, F.normalize(image.float(), dim=-1)


def contrastive(
    text: Float[Tensor, "B D"], image: Float[Tensor, "B D"], log_scale: Tensor
) -> Tensor:
    """Return the mean cross entropy of matching texts and pictures within the batch."""
    logits = log_scale.exp().clamp(max=LARGEST_SCALE) * text @ image.T
    target = torch.arange(len(text), device=text.device)
    return (F.cross_entropy(logits, target) + F.cross_entropy(logits.T, target)) / 2


def trained_clip(folder: Any, vocabulary_size: int) -> Any:
    """Load the trained CLIP's averaged weights, without gradients.

    Raises:
        UserError: it isn't trained.
    """
    clip = models.clip_model(vocabulary_size)
    clip.load_state_dict(entries_below(averaged_weights(folder, "clip"), "clip."))
    return clip.eval().requires_grad_(False)
