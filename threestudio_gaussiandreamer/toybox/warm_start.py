"""Continue a training from published weights: the inverse of ``export.py``."""

import dataclasses
import json
from pathlib import Path
from typing import Any

from torch import Tensor, nn

from ..core.errors import UserError
from ..core.files import existing_file
from ..models.bundled import RECORD
from ..view.run_files import read_json
from .checkpoints import is_trained
from .loop import Options, Progress, Stage, Training
from .new_words import grow_embeddings, grow_tokenizer, separate
from .text_stage import TEXT_PARTS
from .unet_stage import LATENT_SCALE

OF_DIRECTIONS = ("quadrant", "text_finds_object")
"""Measurements that depend on the words for directions, which new words may change."""


def start_from(weights: Path, options: Options, stages: dict[str, type[Stage]]) -> None:
    """Write a checkpoint for every stage of ``weights`` that the training folder has none of.

    Words of the toybox that the weights don't know get tokens with distinct embeddings; the
    networks that read the text encoder learn what they mean. Optimisers start without state; the
    attribute classifiers, which aren't published, start at random.

    Args:
        weights: a folder that ``toybox.export`` wrote.
        stages: all stages by name, in the order in which they depend on each other.

    Raises:
        UserError: a file is missing or holds another model.
    """
    record = read_record(weights)
    options = dataclasses.replace(options, only="")  # which may be of one stage alone
    tokenizer = weights / "stable-diffusion" / "tokenizer"
    new_words = grow_tokenizer(tokenizer, options.folder / "tokenizer")
    for name, stage in stages.items():
        if name in record and not is_trained(options.folder, name):
            training = Training(stage(options))
            state = READERS[name](weights)
            if name == "text":
                grow_embeddings(state, training.model, tokenizer, training.stage.tokenizer)
            _load(training.model, state, weights, name)
            if name == "text" and new_words:
                separate(training.model, training.stage.tokenizer, new_words, options.seed)
            training.ema.module.load_state_dict(training.model.state_dict())
            training.ema.n_averaged.fill_(record[name]["steps"])
            if name == "unet":
                training.stage.constants[LATENT_SCALE] = _latent_scale(weights)
            seen = record[name]
            last = [seen["last"]] if seen["last"] else []
            training.progress = Progress(seen["steps"], seen["images"], history=last)
            training.earlier = seen["trainings"]
            training.measured = {
                key: value
                for key, value in seen["withheld"].items()
                if not (new_words and key in OF_DIRECTIONS)
            }
            training.save()


def read_record(weights: Path) -> dict[str, Any]:
    """Return what ``training.json`` says about each network.

    Raises:
        UserError: it is missing or damaged.
    """
    path = existing_file(weights / RECORD, "record of the toybox's weights")
    record = read_json(path, dict)
    if not record or not all(isinstance(seen, dict) for seen in record.values()):
        raise UserError(f"the record of the toybox's weights {str(path)!r} is damaged")
    return record


def _load(model: nn.Module, state: dict[str, Tensor], weights: Path, name: str) -> None:
    known = model.state_dict()
    differing = [
        key for key, value in state.items() if key not in known or known[key].shape != value.shape
    ]
    if differing or (name not in ("text", "clip") and state.keys() != known.keys()):
        raise UserError(
            f"the weights of {name!r} in {str(weights)!r} are of another model"
            f" ({', '.join(differing[:3]) or 'some are missing'}): use those of this version"
        )
    model.load_state_dict(state, strict=False)


def _read_diffusers(name: str) -> Any:
    return lambda weights: _read(
        weights / "stable-diffusion" / name / "diffusion_pytorch_model.safetensors"
    )


def _read_clip(weights: Path) -> dict[str, Tensor]:
    from transformers import CLIPModel

    return CLIPModel.from_pretrained(weights / "clip").float().state_dict()


def _read_clip_stage(weights: Path) -> dict[str, Tensor]:
    """Read all but the text encoder, which the stage has from the one before."""
    state = _read_clip(weights)
    return {f"clip.{key}": state[key] for key in state if not key.startswith(TEXT_PARTS)}


def _read(path: Path) -> dict[str, Tensor]:
    from safetensors.torch import load_file

    return {key: value.float() for key, value in load_file(existing_file(path, "weights")).items()}


def _read_text(weights: Path) -> dict[str, Tensor]:
    state = _read_clip(weights)
    return {key: value for key, value in state.items() if key.startswith(TEXT_PARTS)}


READERS = {
    "text": _read_text,
    "clip": _read_clip_stage,
    "autoencoder": _read_diffusers("vae"),
    "unet": _read_diffusers("unet"),
    "points": lambda weights: _read(weights / "points.safetensors"),
    "judge": lambda weights: _read(weights / "judge.safetensors"),
}


def _latent_scale(weights: Path) -> float:
    config = existing_file(weights / "stable-diffusion" / "vae" / "config.json", "configuration")
    return float(json.loads(config.read_text(encoding="utf-8"))["scaling_factor"])
