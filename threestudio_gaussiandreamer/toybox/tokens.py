"""Prompts of pictures as token ids, the same for every stage that reads text, and their CLIP
tokenizer: it has one token for every word of the toybox, and makes bytes and pieces of others."""

import json
import re
from collections import Counter
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int
from torch import Tensor

from ..core.errors import UserError
from ..core.files import existing_file, output_folder, write_file
from ..models.bundled import WORDS_FILE
from . import words
from .views import Shard, attributes_of

START, END = "<|startoftext|>", "<|endoftext|>"
WORDS = Path(WORDS_FILE).name
SETTINGS = "tokenizer_config.json"
"""The file that is written last: a folder that has it is complete."""
LENGTH = 32
"""Tokens of a prompt, start and end included; longer ones are cut."""


def write_tokenizer(folder: Path, words: Sequence[str]) -> None:
    """Write a CLIPTokenizer's files, and the list of ``words`` that prompts/prompts.py reads."""
    from tokenizers.pre_tokenizers import ByteLevel

    output_folder(folder, "the tokenizer")
    merges = word_merges(words)
    letters = sorted(ByteLevel.alphabet())
    pieces = [*letters, *(f"{letter}</w>" for letter in letters), *map("".join, merges)]
    tokens = {token: index for index, token in enumerate([*pieces, START, END])}
    special = {"bos_token": START, "eos_token": END, "unk_token": END, "pad_token": END}
    named = {"tokenizer_class": "CLIPTokenizer", "do_lower_case": True}
    contents = {
        "vocab.json": tokens,
        "merges.txt": ["#version: 0.2", *map(" ".join, merges)],
        WORDS: words,
        "special_tokens_map.json": special,
        SETTINGS: special | {"model_max_length": LENGTH} | named,
    }
    for name, content in contents.items():
        text = "\n".join([*content, ""])
        if isinstance(content, dict):
            text = json.dumps(content, ensure_ascii=False, indent=0)
        write_file(folder / name, text)


def copy_tokenizer(source: Path, folder: Path) -> None:
    """Copy the files of a tokenizer."""
    output_folder(folder, "the tokenizer")
    for path in sorted(source.iterdir(), key=lambda path: path.name == SETTINGS):
        write_file(folder / path.name, path.read_bytes())


def word_merges(words: Sequence[str]) -> list[tuple[str, str]]:
    """Return byte pair merges (Sennrich et al. 2016) that make each of ``words`` one token."""
    split = [" ".join([*word[:-1], f"{word[-1]}</w>"]) for word in sorted(set(words))]
    merges = []
    while counts := Counter(pair for pieces in split for pair in pairwise(pieces.split())):
        best = min(counts, key=lambda pair: (-counts[pair], pair))
        both = re.compile(rf"(?<!\S){re.escape(' '.join(best))}(?!\S)")
        split = [both.sub("".join(best), pieces) for pieces in split]
        merges.append(best)
    return merges


JOINED_PLAIN_SHARE = 0.03
"""Fraction of objects with joined views whose prompts name no direction."""


def open_tokenizer(folder: Path) -> Any:
    """Load the training's tokenizer, which is written on first use.

    Raises:
        UserError: it is of an earlier version of the toybox, and lacks words."""
    from transformers import CLIPTokenizer

    place = Path(folder) / "tokenizer"
    if not (place / SETTINGS).is_file():
        write_tokenizer(place, words.vocabulary())
    known = existing_file(place / WORDS, "list of words").read_text(encoding="utf-8").split()
    if missing := sorted(set(words.vocabulary()) - set(known)):
        raise UserError(
            f"the tokenizer {str(place)!r}, of an earlier version, doesn't know "
            f"{', '.join(missing)}: train in another folder"
        )
    return CLIPTokenizer.from_pretrained(str(place))


def token_ids(tokenizer: Any, texts: Sequence[str]) -> Int[Tensor, "B 32"]:
    """Return padded token ids, as Stable Diffusion's prompt processors make them."""
    options = {"padding": "max_length", "max_length": LENGTH, "truncation": True}
    return tokenizer(list(texts), **options, return_tensors="pt").input_ids


def training_prompts(shard: Shard, rows: np.ndarray, rng: np.random.Generator) -> list[str]:
    """Write a prompt for each picture: see :func:`words.prompt_of`."""
    views = zip(shard.labels[rows], shard.elevation[rows], shard.azimuth[rows], strict=True)
    return [words.prompt_of(attributes_of(row), *angles, rng) for row, *angles in views]


def joined_prompts(
    shard: Shard, objects: np.ndarray, views: int, rng: np.random.Generator
) -> list[str]:
    """Write prompts for all views of these objects: the same words, and each view's direction; or
    of some only empty prompts, or prompts without a direction."""
    texts: list[str] = []
    for row in objects:
        share = rng.random()
        empty = share < words.EMPTY_SHARE
        text = "" if empty else words.describe(attributes_of(shard.labels[row * views]), rng)
        if share < words.EMPTY_SHARE + JOINED_PLAIN_SHARE:
            texts += [text] * views
        else:
            names = _directions(shard, np.arange(row * views, (row + 1) * views))
            texts += [f"{text}, {name} view" for name in names]
    return texts


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
        opposite: name the opposite direction instead."""
    texts, names = object_prompts(shard.labels[rows], rng), _directions(shard, rows)
    names = [words.OPPOSITE[name] for name in names] if opposite else names
    return [f"{text}, {name} view" for text, name in zip(texts, names, strict=True)]
