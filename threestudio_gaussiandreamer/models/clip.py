"""CLIP in transformers' format: text features, which condition Point-E and Shap-E, trained with
``openai/clip-vit-large-patch14``, and the similarity of pictures and texts, by any CLIP."""

from functools import partial
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.extras import require_extra
from .bundled import CLIP, model_part
from .hub import Source, locate
from .model_files import load_network, load_settings, needed_files

MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Mean and standard deviation of CLIP's training pictures per channel."""


def clip_source(
    model: str, *, option: str = "system.geometry.prior.clip", allow_bin: Optional[bool] = None
) -> Source:
    """Describe a CLIP with both encoders and its tokenizer, the value of ``option``: a folder or a
    hub id. For ``allow_bin`` see :func:`.model_files.component_weights`.
    """
    picks = partial(needed_files, components=[""], allow_bin=allow_bin)
    return Source(model_part(model, CLIP), picks, option)


def load_text_encoder(folder: Path, component: str = "", *, allow_bin=None) -> Any:
    """Load ``CLIPTextModelWithProjection``, float32, also from a CLIP with both encoders."""
    from transformers import CLIPTextModelWithProjection

    return load_network(CLIPTextModelWithProjection, folder, component, allow_bin=allow_bin).float()


def load_tokenizer(folder: Path, component: str = "") -> Any:
    from transformers import CLIPTokenizer

    return load_settings(CLIPTokenizer, folder, component)


def token_ids(tokenizer: Any, text: str, most: int = 77) -> Tensor:
    """Return token ids (1, L), truncated to the model's length, not padded: attention is causal."""
    length = min(tokenizer.model_max_length, most)
    return tokenizer(text, truncation=True, max_length=length, return_tensors="pt").input_ids


@torch.no_grad()
def text_condition(tokenizer: Any, encoder: Any, text: str) -> Float[Tensor, "1 D"]:
    """Return the text's features, scaled to length sqrt(D)."""
    features = encoder(token_ids(tokenizer, text).to(encoder.device)).text_embeds.float()
    return features / features.norm(dim=-1, keepdim=True) * features.shape[-1] ** 0.5


@torch.no_grad()
def text_features(source: Source, text: str) -> Float[Tensor, "1 D"]:
    """Return features of a text as MDM has them: of 22 tokens at most, of any norm; on the CPU."""
    folder = locate(source)
    encoder = load_text_encoder(folder, allow_bin=True)  # where the source allows it
    return encoder(token_ids(load_tokenizer(folder), text, 22)).text_embeds.float()


class PictureText:
    """Load a CLIP with both encoders and compute similarities of pictures and texts."""

    def __init__(self, source: Source, device: torch.device, *, allow_bin=None) -> None:
        require_extra("diffusion", "transformers")
        from transformers import CLIPModel

        folder = locate(source)
        self._model = load_network(CLIPModel, folder, allow_bin=allow_bin).float().to(device)
        self._tokenizer, self._device = load_tokenizer(folder), device

    @torch.no_grad()
    def similarities(
        self, pictures: Float[np.ndarray, "N H W 3"], text: str, *, batch: int = 32
    ) -> Float[np.ndarray, "N"]:
        """Return the cosine similarity of each picture (values in [0, 1]) and ``text``."""
        ids = token_ids(self._tokenizer, text).to(self._device)
        (wanted,) = _unit_features(self._model.get_text_features(ids))
        size, found = self._model.config.vision_config.image_size, []
        for start in range(0, len(pictures), batch):
            chunk = preprocessed(pictures[start : start + batch], size).to(self._device)
            found.append(_unit_features(self._model.get_image_features(chunk)) @ wanted)
        return torch.cat(found).cpu().numpy()


def _unit_features(output: Any) -> Tensor:
    """Return features of length 1: transformers 4 returns a tensor, 5 an object that has it."""
    features = output if isinstance(output, Tensor) else output.pooler_output
    return features / features.norm(dim=-1, keepdim=True)


def preprocessed(pictures: Float[np.ndarray, "N H W 3"], size: int) -> Float[Tensor, "N 3 S S"]:
    """Resize pictures in [0, 1] bicubically, and normalise them."""
    pixels = torch.from_numpy(np.ascontiguousarray(pictures, np.float32)).permute(0, 3, 1, 2)
    if pixels.shape[-2:] != (size, size):
        smooth = {"mode": "bicubic", "antialias": True}
        pixels = torch.nn.functional.interpolate(pixels, (size, size), **smooth).clamp(0, 1)
    return normalized(pixels)


def normalized(pixels: Float[Tensor, "N 3 S S"]) -> Float[Tensor, "N 3 S S"]:
    """Normalise pictures in [0, 1] as CLIP's training pictures."""
    return (pixels - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
