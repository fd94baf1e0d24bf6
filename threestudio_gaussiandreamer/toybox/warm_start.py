"""Continue a training from published weights, the inverse of ``export.py``."""

import json
from pathlib import Path

from torch import Tensor

from ..core.errors import UserError
from ..core.files import existing_file
from ..models.bundled import RECORD
from ..view.run_files import read_json
from . import tokens
from .clip_stage import TEXT_PARTS
from .loop import Options, Progress, Stage, Training, is_trained
from .unet_stage import LATENT_SCALE

FILES = {
    "autoencoder": "stable-diffusion/vae/diffusion_pytorch_model.safetensors",
    "unet": "stable-diffusion/unet/diffusion_pytorch_model.safetensors",
    "points": "points.safetensors",
    "judge": "judge.safetensors",
}


def start_from(weights: Path, options: Options, stages: dict[str, type[Stage]]) -> None:
    """Write a checkpoint for every stage of ``weights`` that the training folder has none of.

    Optimisers start without state; the attribute classifiers, which aren't published, start at
    random.

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
    if not (options.folder / "tokenizer" / tokens.SETTINGS).is_file():
        source = weights / "stable-diffusion" / "tokenizer"
        existing_file(source / tokens.SETTINGS, "tokenizer")
        tokens.copy_tokenizer(source, options.folder / "tokenizer")
    for name, stage in stages.items():
        if name in record and not is_trained(options.folder, name):
            training, seen = Training(stage(options)), record[name]
            try:  # the classifiers of text and CLIP aren't published
                state = read_weights(weights, name)
                training.model.load_state_dict(state, strict=name not in ("text", "clip"))
            except RuntimeError as error:
                raise UserError(
                    f"the weights of {name!r} in {str(weights)!r} are of another model than those "
                    f"of this version: {error}"
                ) from error
            training.ema.module.load_state_dict(training.model.state_dict())
            training.ema.n_averaged.fill_(seen["steps"])
            if name == "unet":
                vae = existing_file(weights / "stable-diffusion/vae/config.json", "configuration")
                scale = json.loads(vae.read_text(encoding="utf-8"))["scaling_factor"]
                training.stage.constants[LATENT_SCALE] = float(scale)
            last = [seen["last"]] if seen["last"] else []
            training.progress = Progress(seen["steps"], seen["images"], history=last)
            training.earlier, training.measured = seen["trainings"], seen["withheld"]
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
