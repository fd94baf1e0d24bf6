"""CLIP from transformers' files: the text features that Point-E and Shap-E are conditioned on, and how well pictures fit a text.

Folders and model ids as in ``pretrained.py``. The published 3D models were trained with OpenAI's ViT-L/14
(``openai/clip-vit-large-patch14``); pictures may be compared with any CLIP.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..hub import files_below
from .pretrained import WeightFile, free_memory, load_weights, locate, pick_weights, reading, require_extra, require_files, tokenizer_files

MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Of CLIP's training pictures, per channel; the same for all of OpenAI's and OpenCLIP's models."""


class ClipFiles:
    """Which files a CLIP in a folder or on the hub consists of."""

    def __init__(self, model: str, *, option: str, allow_bin: bool = False) -> None:
        self.model, self.option, self.allow_bin = model, option, allow_bin

    def picks(self, files: Collection[str]) -> list[str]:
        return [*require_files(files, ["config.json"], self.model), *tokenizer_files(files, "", self.model), self.weights(files).name]

    def weights(self, files: Collection[str]) -> WeightFile:
        return pick_weights(files, "", "model", allow_bin=self.allow_bin, model=self.model)

    def locate(self, download: bool = True) -> Optional[Path]:
        return locate(self.model, self.picks, option=self.option, download=download)


def load_text_encoder(folder: Path, weights: WeightFile, subfolder: str = "") -> Any:
    """transformers' ``CLIPTextModelWithProjection`` in float32, in evaluation mode; also from the files of a whole CLIP."""
    from transformers import CLIPTextModelWithProjection

    return load_weights(CLIPTextModelWithProjection, folder, weights, subfolder)


def load_tokenizer(folder: Path, subfolder: str = "") -> Any:
    from transformers import CLIPTokenizer

    with reading(f"the tokenizer in {str(folder / subfolder)!r}"):
        return CLIPTokenizer.from_pretrained(folder, subfolder=subfolder, local_files_only=True)


def token_ids(tokenizer: Any, text: str) -> Tensor:
    """(1, L) token ids, cut to the model's length. Without padding: CLIP's attention is causal, so what follows the end
    of the text has no influence on it."""
    return tokenizer(text, truncation=True, max_length=min(tokenizer.model_max_length, 77), return_tensors="pt").input_ids


@torch.no_grad()
def text_condition(tokenizer: Any, encoder: Any, text: str) -> Float[Tensor, "1 D"]:
    """The text's features with unit variance: normalised, times sqrt(D). No prompt is a vector of zeros."""
    features = encoder(token_ids(tokenizer, text).to(encoder.device)).text_embeds.float()
    return features / features.norm(dim=-1, keepdim=True) * features.shape[-1] ** 0.5


class PictureText:
    """A whole CLIP, loaded: how well pictures fit texts."""

    def __init__(self, files: ClipFiles, device: torch.device) -> None:
        require_extra("diffusion", "transformers")
        from transformers import CLIPModel

        folder = files.locate()
        self._model = load_weights(CLIPModel, folder, files.weights(files_below(folder))).to(device)
        self._tokenizer, self._device = load_tokenizer(folder), device

    @torch.no_grad()
    def similarities(self, pictures: Float[np.ndarray, "N H W 3"], text: str, *, batch: int = 32) -> Float[np.ndarray, "N"]:
        """The cosine between each picture (values in [0, 1]) and ``text``."""
        wanted = _unit(_features(self._model.get_text_features(token_ids(self._tokenizer, text).to(self._device))))
        size = self._model.config.vision_config.image_size
        chunks = [_preprocessed(pictures[start : start + batch], size).to(self._device) for start in range(0, len(pictures), batch)]
        return torch.cat([_unit(_features(self._model.get_image_features(chunk))) @ wanted[0] for chunk in chunks]).cpu().numpy()


def picture_similarities(
    files: ClipFiles, pictures: Float[np.ndarray, "N H W 3"], text: str, *, device: torch.device, batch: int = 32
) -> Float[np.ndarray, "N"]:
    """The cosine between each picture (values in [0, 1]) and ``text``; the model is loaded for this and freed."""
    scores = PictureText(files, device).similarities(pictures, text, batch=batch)
    free_memory()
    return scores


def _features(output: Any) -> Tensor:
    """transformers 4 gives the tensor, 5 an object that has it."""
    return output if isinstance(output, Tensor) else output.pooler_output


def _unit(features: Tensor) -> Tensor:
    return features / features.norm(dim=-1, keepdim=True)


def _preprocessed(pictures: Float[np.ndarray, "N H W 3"], size: int) -> Float[Tensor, "N 3 S S"]:
    pixels = torch.from_numpy(np.ascontiguousarray(pictures, np.float32)).permute(0, 3, 1, 2)
    if pixels.shape[-2:] != (size, size):
        pixels = torch.nn.functional.interpolate(pixels, (size, size), mode="bicubic", antialias=True).clamp(0, 1)
    return (pixels - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
