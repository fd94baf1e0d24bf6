"""Tokens and embeddings of words that published weights don't know."""

import json
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import functional_call
from tqdm import tqdm

from ..core.files import existing_file
from ..core.streams import numpy_generator
from . import words
from .text_batches import missing_words, token_ids
from .tokenizer import copy_tokenizer, is_complete, words_of, write_tokenizer
from .views import random_angles
from .world import draw_attributes

EMBEDDINGS = "text_model.embeddings.token_embedding.weight"
WORDS_QUANTILE, LENGTHENED = 0.9, 1.3
"""New words' embeddings are at most LENGTHENED times as long as this quantile of all lengths. Most
tokens are letters and pieces that occur in no prompt, and have shorter embeddings than words.
"""
SEPARATION_STEPS, SEPARATION_PROMPTS, SEPARATION_RATE = 150, 24, 0.02


def grow_tokenizer(source: Path, folder: Path) -> list[str]:
    """Write a tokenizer of the words of ``source`` and of the toybox, unless ``folder`` has
    one.

    Args:
        source: folder of the weights' tokenizer.

    Returns:
        The words of the toybox that the weights don't know, sorted.
    """
    known = words_of(source)
    new = missing_words(known)
    if not is_complete(folder):
        if new:
            write_tokenizer(folder, sorted([*known, *new]))
        else:
            copy_tokenizer(source, folder)
    return new


def grow_embeddings(
    state: dict[str, Tensor], model: nn.Module, source: Path, tokenizer: Any
) -> None:
    """Arrange the token embeddings of ``state``, the weights of a text encoder, for ``tokenizer``.

    New tokens keep the random embeddings of ``model``, lengthened to those of trained words.

    Args:
        source: folder of the tokenizer of ``state``.
    """
    path = existing_file(source / "vocab.json", "vocabulary")
    old, new = json.loads(path.read_text(encoding="utf-8")), tokenizer.get_vocab()
    trained, fresh = state[EMBEDDINGS], model.state_dict()[EMBEDDINGS].cpu()
    if trained.shape[1] != fresh.shape[1]:
        return  # weights of another model, which are refused when they are loaded
    rows = fresh * (_length(trained) / fresh.norm(dim=1, keepdim=True))
    shared = sorted(old.keys() & new.keys())
    rows[[new[token] for token in shared]] = trained[[old[token] for token in shared]]
    state[EMBEDDINGS] = rows


def separate(model: nn.Module, tokenizer: Any, new_words: Sequence[str], seed: int) -> None:
    """Optimise the embeddings of ``new_words`` so that prompts that differ in one of these words
    have hidden states as far apart as possible; all other weights stay as they are.

    With random embeddings the hidden states of "left" and "right" differ by a quarter of those of
    "front" and "back", and the U-Net hardly learns to distinguish them.

    Args:
        model: has the text encoder as ``text_model``; changed in place.
    """
    embeddings = model["text_model"].embeddings.token_embedding.weight
    tokens = tokenizer.convert_tokens_to_ids([f"{word}</w>" for word in new_words])
    ids = torch.tensor(tokens, device=embeddings.device)
    table = embeddings.detach().clone()
    longest, rows = LENGTHENED * _length(table), table[ids].requires_grad_(True)
    optimizer = torch.optim.Adam([rows], lr=SEPARATION_RATE)
    for step in tqdm(range(SEPARATION_STEPS), "new words", unit="step", disable=None):
        pairs = pairs_of_prompts(new_words, numpy_generator(seed, "new-words", step))
        if not pairs:
            continue
        weights = {"embeddings.token_embedding.weight": table.index_copy(0, ids, rows)}
        first, second = (
            functional_call(model["text_model"], weights, (token_ids(tokenizer, texts).to(ids),))
            for texts in zip(*pairs, strict=True)
        )
        apart = (first.last_hidden_state - second.last_hidden_state).flatten(1).norm(dim=1)
        optimizer.zero_grad()
        (-apart.mean()).backward()
        optimizer.step()
        with torch.no_grad():
            rows *= (longest / rows.norm(dim=1, keepdim=True)).clamp(max=1)
    with torch.no_grad():
        embeddings[ids] = rows


def pairs_of_prompts(new_words: Sequence[str], rng: np.random.Generator) -> list[tuple[str, str]]:
    """Write training prompts, and keep those that have a new word, each with a copy in which
    another one, or none if there is only one, takes its place.
    """
    pairs: list[tuple[str, str]] = []
    for _ in range(SEPARATION_PROMPTS):
        attributes = draw_attributes(int(rng.integers(2**31)), 0)
        text = words.prompt_of(attributes, *random_angles(rng), rng)
        for word in sorted(set(new_words) & set(re.findall(r"\w+", text))):
            others = [other for other in new_words if other != word] or [""]
            other = others[int(rng.integers(len(others)))]
            pairs.append((text, re.sub(rf"\b{word}\b", other, text)))
    return pairs


def _length(embeddings: Tensor) -> Tensor:
    """Return the length of a word's embedding."""
    return embeddings.norm(dim=1).quantile(WORDS_QUANTILE)
