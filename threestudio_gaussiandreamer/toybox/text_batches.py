"""Prompts of pictures as token ids, the same for every stage that reads text."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from ..core.errors import UserError
from . import words
from .tokenizer import LENGTH, is_complete, words_of, write_tokenizer
from .views import Shard, attributes_of

JOINED_PLAIN_SHARE = 0.03
"""Fraction of objects with joined views whose prompts name no direction."""


def open_tokenizer(folder: Path) -> Any:
    """Load the training's tokenizer, which is written on first use.

    Raises:
        UserError: it is of an earlier version of the toybox, and lacks words; or it can't be
            written.
    """
    from transformers import CLIPTokenizer

    place = Path(folder) / "tokenizer"
    if not is_complete(place):
        write_tokenizer(place, words.vocabulary())
    if missing := missing_words(words_of(place)):
        raise UserError(
            f"the tokenizer {str(place)!r} doesn't know {', '.join(missing)}: export the training "
            "(python -m threestudio_gaussiandreamer.toybox.export), and continue it in another "
            "folder with --from-weights"
        )
    return CLIPTokenizer.from_pretrained(str(place))


def missing_words(known: Sequence[str]) -> list[str]:
    """Return the words of the toybox that aren't in ``known``, sorted."""
    return sorted(set(words.vocabulary()) - set(known))


def token_ids(tokenizer: Any, texts: Sequence[str]) -> Int[Tensor, "B 32"]:
    """Return padded token ids, as Stable Diffusion's prompt processors make them."""
    options = {
        "padding": "max_length",
        "max_length": LENGTH,
        "truncation": True,
        "return_tensors": "pt",
    }
    return tokenizer(list(texts), **options).input_ids


def training_prompts(shard: Shard, rows: np.ndarray, rng: np.random.Generator) -> list[str]:
    """Write a prompt for each picture: see :func:`words.prompt_of`."""
    views = zip(shard.labels[rows], shard.elevation[rows], shard.azimuth[rows], strict=True)
    return [
        words.prompt_of(attributes_of(row), elevation, azimuth, rng)
        for row, elevation, azimuth in views
    ]


def joined_prompts(
    shard: Shard, objects: np.ndarray, views: int, rng: np.random.Generator
) -> list[str]:
    """Write prompts for all views of these objects: the same words, and each view's direction.

    Some objects have only empty prompts, and some only prompts without a direction.
    """
    return [text for row in objects for text in _prompts_of_object(shard, row, views, rng)]


def _prompts_of_object(shard: Shard, row: int, views: int, rng: np.random.Generator) -> list[str]:
    share = rng.random()
    if share < words.EMPTY_SHARE:
        return [""] * views
    text = words.describe(attributes_of(shard.labels[row * views]), rng)
    if share < words.EMPTY_SHARE + JOINED_PLAIN_SHARE:
        return [text] * views
    names = _directions(shard, np.arange(row * views, (row + 1) * views))
    return [f"{text}, {name} view" for name in names]


def _directions(shard: Shard, rows: np.ndarray) -> list[str]:
    angles = zip(shard.elevation[rows], shard.azimuth[rows], strict=True)
    return [words.direction(*view) for view in angles]


def object_prompts(labels: np.ndarray, rng: np.random.Generator) -> list[str]:
    """Write a prompt without a direction for each row of labels."""
    return [words.describe(attributes_of(row), rng) for row in labels]


def view_prompts(
    shard: Shard, rows: np.ndarray, rng: np.random.Generator, *, opposite: bool = False
) -> list[str]:
    """Write a prompt with its direction for each picture, as the prompt processors write it.

    Args:
        opposite: name the opposite direction instead.
    """
    texts = object_prompts(shard.labels[rows], rng)
    names = _directions(shard, rows)
    if opposite:
        names = [words.OPPOSITE[name] for name in names]
    return [f"{text}, {name} view" for text, name in zip(texts, names, strict=True)]


def label_tensor(shard: Shard, rows: np.ndarray) -> Int[Tensor, "B L"]:
    """Return the classes of the pictures."""
    return torch.from_numpy(shard.labels[rows])
