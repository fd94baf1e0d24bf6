"""Write the toybox's averaged weights in the published formats, in float16.

``python -m threestudio_gaussiandreamer.toybox.export TRAINING_FOLDER MODELS_FOLDER``

====================  ==========================================================================
stable-diffusion/     diffusers' pipeline: tokenizer, text_encoder, vae, unet, scheduler
clip/                 transformers' CLIPModel and tokenizer: both towers
points.safetensors    Point-E's base checkpoint
motion/               MDM's checkpoint, with the mean and the deviation of its features
body.npz              the body of tools/toybox_body.py, in SMPL's format
judge.safetensors     the judge, which has no published format
training.json         what each network has seen: images, hours, numbers on withheld objects
SHA256SUMS            digests of all other files
====================  ==========================================================================
"""

import argparse
import functools
import json
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from torch import Tensor

from ..core.checkpoint_file import load_file
from ..core.command import run_command
from ..core.errors import UserError
from ..core.files import atomic_file, output_folder, write_file
from ..models.bundled import BODY, FOLDER, MOTION, RECORD, write_digests
from ..priors.text_to_motion import ACTIONS, STATISTICS, mdm_files
from . import models, words
from .clip_stage import trained_clip
from .loop import averaged_weights, checkpoint_path, is_trained
from .motion_stage import TIMESTEPS, MotionStage
from .tokens import copy_tokenizer
from .train import STAGES
from .unet_stage import LATENT_SCALE, frozen_autoencoder


def export(training: Path, target: Path) -> dict[str, Any]:
    """Write the models of a training that has all of text, clip, autoencoder and unet; of points,
    motion and judge those that it has. Return what ``training.json`` says.

    Raises:
        UserError: a stage isn't trained yet, or the disk is full."""
    _, clip = trained_clip(training, "clip")
    _save(clip, target / "clip")
    copy_tokenizer(training / "tokenizer", target / "clip")
    write_stable_diffusion(target / "stable-diffusion", training, clip)
    for name in ("points", "judge"):
        if is_trained(training, name):
            write_weights(target / f"{name}.safetensors", averaged_weights(training, name))
    if is_trained(training, "motion"):
        write_motion_model(target / MOTION, training)
        write_file(target / BODY, (FOLDER / BODY).read_bytes())
    record = training_record(training)
    write_file(target / RECORD, json.dumps(record, indent=2))
    write_digests(target)
    return record


def write_stable_diffusion(folder: Path, training: Path, clip: Any) -> None:
    """Write a Stable Diffusion pipeline's folder."""
    from transformers import CLIPTextModel

    text_encoder = CLIPTextModel(clip.config.text_config)
    # whose names have a prefix or none, by the version of transformers
    getattr(text_encoder, "text_model", text_encoder).load_state_dict(clip.text_model.state_dict())
    vae, unet = frozen_autoencoder(training), models.unet()
    content = load_file(checkpoint_path(training, "unet"))
    unet.load_state_dict(averaged_weights(training, "unet"))
    vae.register_to_config(scaling_factor=content["constants"][LATENT_SCALE])
    for name, network in (("text_encoder", text_encoder), ("vae", vae), ("unet", unet)):
        _save(network, folder / name)
    copy_tokenizer(training / "tokenizer", folder / "tokenizer")
    models.scheduler().save_pretrained(folder / "scheduler")
    write_file(folder / "model_index.json", json.dumps(MODEL_INDEX, indent=2))


MODEL_INDEX = {
    "_class_name": "StableDiffusionPipeline", "feature_extractor": [None, None],
    "safety_checker": [None, None], "requires_safety_checker": False,
    "scheduler": ["diffusers", "DDPMScheduler"], "text_encoder": ["transformers", "CLIPTextModel"],
    "tokenizer": ["transformers", "CLIPTokenizer"], "unet": ["diffusers", "UNet2DConditionModel"],
    "vae": ["diffusers", "AutoencoderKL"],
}  # fmt: skip


def write_weights(path: Path, weights: dict[str, Tensor]) -> None:
    """Write weights by name as safetensors: Point-E's base checkpoint, or the judge's."""
    from safetensors.torch import save

    write_file(path, save({name: value.half().contiguous() for name, value in weights.items()}))


def write_motion_model(path: Path, training: Path) -> None:
    """Write a text-to-motion model as MDM's authors publish theirs, in float16."""
    content = load_file(checkpoint_path(training, "motion"))
    network = MotionStage.network()
    network.load_state_dict(averaged_weights(training, "motion"))
    state, args = mdm_files(network, TIMESTEPS)
    output_folder(path.parent, "the motion model")
    with atomic_file(path) as file:
        torch.save({name: value.half() for name, value in state.items()}, file)
    write_file(path.parent / "args.json", json.dumps(args, indent=2))
    write_file(path.parent / ACTIONS, "\n".join(words.ACTION_PHRASES))
    for name, key in zip(STATISTICS, ("mean", "std"), strict=True):
        with atomic_file(path.parent / name) as file:
            np.save(file, np.float32(content["constants"][key]))


def training_record(training: Path) -> dict[str, Any]:
    """Return what each network of a training has seen, and its last losses."""
    record = {}
    for name in STAGES:
        if is_trained(training, name):
            content = load_file(checkpoint_path(training, name))
            hours = round(content["seconds"] / 3600, 3)
            own = [{"device": content["device"], "hours": hours}] if hours else []
            last = content["history"][-1] if content["history"] else {}
            seen = {"images": content["images"], "steps": content["step"]}
            seen |= {"trainings": content["earlier"] + own, "last": last}
            record[name] = seen | {"withheld": content["measured"]}
    return record


def _save(network: Any, folder: Path) -> None:
    network.half().save_pretrained(str(folder), safe_serialization=True)


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        prog=f"python -m {__package__}.export", description="Write the toybox's models."
    )
    parser.add_argument("training", type=Path, help="folder of toybox.train")
    parser.add_argument("target", type=Path, help="folder for the models")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> None:
    """Write the models, and print their size."""
    from safetensors import SafetensorError

    target = output_folder(args.target, "TARGET")
    try:
        record = export(args.training, target)
    except (OSError, SafetensorError) as error:  # the latter if the disk is full
        reason = getattr(error, "strerror", None) or error
        raise UserError(f"cannot write {str(target)!r}: {reason}") from error
    size = sum(path.stat().st_size for path in target.rglob("*") if path.is_file())
    print(f"{target}: {', '.join(record)}, {size / 1e6:.1f} MB")


main = functools.partial(run_command, parse, run)


if __name__ == "__main__":
    sys.exit(main())
