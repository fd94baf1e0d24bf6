"""Continue a training from published weights, the inverse of ``export.py``. Words of the toybox
that they don't know get tokens and embeddings.
"""

import dataclasses
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

from ..core.errors import UserError
from ..core.files import existing_file
from ..core.streams import numpy_generator
from ..models.bundled import RECORD
from ..view.run_files import read_json
from . import tokens, words
from .clip_stage import TEXT_PARTS
from .loop import Options, Progress, Stage, Training, is_trained
from .unet_stage import LATENT_SCALE
from .views import random_angles
from .world import draw_attributes

EMBEDDINGS = "text_model.embeddings.token_embedding.weight"
WORDS_QUANTILE, LENGTHENED = 0.9, 1.3
"""New words' embeddings are at most LENGTHENED times as long as this quantile of all lengths. Most
tokens are letters and pieces that occur in no prompt, and have shorter embeddings than words.
"""
SEPARATION_STEPS, SEPARATION_PROMPTS, SEPARATION_RATE = 150, 24, 0.02


def start_from(weights: Path, options: Options, stages: dict[str, type[Stage]]) -> None:
    """Write a checkpoint for every stage of ``weights`` that the training folder has none of.

    Words of the toybox that the weights don't know get tokens with distinct embeddings; the
    networks that read the text encoder learn what they mean. Optimisers start without state; the
    attribute classifiers, which aren't published, start at random.

    Args:
        weights: a folder that ``toybox.export`` wrote.
        stages: all stages by name, in the order in which they depend on each other.

    Raises:
        UserError: a file is missing or damaged, or holds another model.
    """
    path = existing_file(weights / RECORD, "record of the toybox's weights")
    record = read_json(path, dict)
    if not record or not all(isinstance(seen, dict) for seen in record.values()):
        raise UserError(f"the record of the toybox's weights {str(path)!r} is damaged")
    options = dataclasses.replace(options, only="")  # which may be of one stage alone
    tokenizer = weights / "stable-diffusion" / "tokenizer"
    new_words = grow_tokenizer(tokenizer, options.folder / "tokenizer")
    for name, stage in stages.items():
        if name in record and not is_trained(options.folder, name):
            training, seen = Training(stage(options)), record[name]
            model, state = training.model, read_weights(weights, name)
            if name == "text":
                grow_embeddings(state, model, tokenizer, training.stage.tokenizer)
            try:  # the classifiers of text and CLIP aren't published
                model.load_state_dict(state, strict=name not in ("text", "clip"))
            except RuntimeError as error:
                raise UserError(
                    f"the weights of {name!r} in {str(weights)!r} are of another model than those "
                    f"of this version: {error}"
                ) from error
            if name == "text" and new_words:
                separate(model, training.stage.tokenizer, new_words, options.seed)
            training.ema.module.load_state_dict(model.state_dict())
            training.ema.n_averaged.fill_(seen["steps"])
            if name == "unet":
                vae = existing_file(weights / "stable-diffusion/vae/config.json", "configuration")
                scale = json.loads(vae.read_text(encoding="utf-8"))["scaling_factor"]
                training.stage.constants[LATENT_SCALE] = float(scale)
            last = [seen["last"]] if seen["last"] else []
            training.progress = Progress(seen["steps"], seen["images"], history=last)
            training.earlier = seen["trainings"]
            training.measured = {} if new_words else seen["withheld"]
            training.save()


def read_weights(weights: Path, name: str) -> dict[str, Tensor]:
    """Read an export's weights of a stage's network, float32; of "clip" all but the text encoder,
    which the stage has from the one before.
    """
    from safetensors.torch import load_file
    from transformers import CLIPModel

    if name in ("text", "clip"):
        state = CLIPModel.from_pretrained(weights / "clip").float().state_dict()
        prefix = "" if name == "text" else "clip."
        kept = (key for key in state if key.startswith(TEXT_PARTS) == (name == "text"))
        return {f"{prefix}{key}": state[key] for key in kept}
    path = existing_file(weights / FILES[name], "weights")
    return {key: value.float() for key, value in load_file(path).items()}


FILES = {
    "autoencoder": "stable-diffusion/vae/diffusion_pytorch_model.safetensors",
    "unet": "stable-diffusion/unet/diffusion_pytorch_model.safetensors",
    "points": "points.safetensors",
    "judge": "judge.safetensors",
}


# New words ------------------------------------------------------------------------------------


def grow_tokenizer(source: Path, folder: Path) -> list[str]:
    """Write a tokenizer of the words of ``source`` and of the toybox, unless ``folder`` has
    one.

    Args:
        source: folder of the weights' tokenizer.

    Returns:
        The words of the toybox that the weights don't know, sorted.
    """
    known = tokens.words_of(source)
    new = tokens.missing_words(known)
    if not (folder / tokens.SETTINGS).is_file():
        if new:
            tokens.write_tokenizer(folder, sorted([*known, *new]))
        else:
            tokens.copy_tokenizer(source, folder)
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
    of_words = tokenizer.convert_tokens_to_ids([f"{word}</w>" for word in new_words])
    ids = torch.tensor(of_words, device=embeddings.device)
    table = embeddings.detach().clone()
    longest, rows = LENGTHENED * _length(table), table[ids].requires_grad_(True)
    optimizer = torch.optim.Adam([rows], lr=SEPARATION_RATE)
    for step in tqdm(range(SEPARATION_STEPS), "new words", unit="step", disable=None):
        pairs = pairs_of_prompts(new_words, numpy_generator(seed, "new-words", step))
        if not pairs:
            continue
        weights = {"embeddings.token_embedding.weight": table.index_copy(0, ids, rows)}
        batches = (tokens.token_ids(tokenizer, texts).to(ids) for texts in zip(*pairs, strict=True))
        first, second = (
            functional_call(model["text_model"], weights, (batch,)).last_hidden_state
            for batch in batches
        )
        apart = (first - second).flatten(1).norm(dim=1)
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
