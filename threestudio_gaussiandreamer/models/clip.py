"""CLIP from transformers' files: the text features that Point-E and Shap-E are conditioned on, and
how well pictures fit a text.

Folders and model ids as in ``hub.py``. The published 3D models were trained with OpenAI's ViT-L/14
(``openai/clip-vit-large-patch14``); pictures may be compared with any CLIP.
"""

from collections.abc import Collection
from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from .extras import require_extra
from .hub import Source, locate
from .model_files import (
    component_files,
    free_memory,
    load_network,
    load_settings,
    require_vocabulary,
)

MEAN, STD = (0.48145466, 0.4578275, 0.40821073), (0.26862954, 0.26130258, 0.27577711)
"""Of CLIP's training pictures, per channel; the same for all of OpenAI's and OpenCLIP's models."""


def clip_source(
    model: str, *, option: str = "system.geometry.prior.clip", allow_bin: Optional[bool] = None
) -> Source:
    """A whole CLIP in a folder or on the hub, as an option names it."""

    def picks(names: Collection[str]) -> list[str]:
        needed = component_files(names, "", allow_bin=allow_bin)
        require_vocabulary(names, "")
        return needed

    return Source(model, picks, option)


def load_text_encoder(
    folder: Path, component: str = "", *, allow_bin: Optional[bool] = None
) -> Any:
    """transformers' ``CLIPTextModelWithProjection`` in float32, in evaluation mode; also from the
    files of a whole CLIP.
    """
    from transformers import CLIPTextModelWithProjection

    return load_network(CLIPTextModelWithProjection, folder, component, allow_bin=allow_bin).float()


def load_tokenizer(folder: Path, component: str = "") -> Any:
    from transformers import CLIPTokenizer

    return load_settings(CLIPTokenizer, folder, component)


def token_ids(tokenizer: Any, text: str) -> Tensor:
    """(1, L) token ids, cut to the model's length. Without padding: CLIP's attention is causal, so
    what follows the end of the text has no influence on it.
    """
    return tokenizer(
        text, truncation=True, max_length=min(tokenizer.model_max_length, 77), return_tensors="pt"
    ).input_ids


@torch.no_grad()
def text_condition(tokenizer: Any, encoder: Any, text: str) -> Float[Tensor, "1 D"]:
    """The text's features with unit variance: normalised, times sqrt(D). No prompt is a vector of
    zeros.
    """
    features = encoder(token_ids(tokenizer, text).to(encoder.device)).text_embeds.float()
    return features / features.norm(dim=-1, keepdim=True) * features.shape[-1] ** 0.5


class PictureText:
    """A whole CLIP, loaded: how well pictures fit texts."""

    def __init__(
        self, source: Source, device: torch.device, *, allow_bin: Optional[bool] = None
    ) -> None:
        require_extra("diffusion", "transformers")
        from transformers import CLIPModel

        folder = locate(source)
        self._model = load_network(CLIPModel, folder, allow_bin=allow_bin).float().to(device)
        self._tokenizer, self._device = load_tokenizer(folder), device

    @torch.no_grad()
    def similarities(
        self, pictures: Float[np.ndarray, "N H W 3"], text: str, *, batch: int = 32
    ) -> Float[np.ndarray, "N"]:
        """The cosine between each picture (values in [0, 1]) and ``text``."""
        wanted = _unit(
            _features(
                self._model.get_text_features(token_ids(self._tokenizer, text).to(self._device))
            )
        )
        size = self._model.config.vision_config.image_size
        chunks = [
            _preprocessed(pictures[start : start + batch], size).to(self._device)
            for start in range(0, len(pictures), batch)
        ]
        return (
            torch.cat(
                [
                    _unit(_features(self._model.get_image_features(chunk))) @ wanted[0]
                    for chunk in chunks
                ]
            )
            .cpu()
            .numpy()
        )


def picture_similarities(
    source: Source,
    pictures: Float[np.ndarray, "N H W 3"],
    text: str,
    *,
    device: torch.device,
    batch: int = 32,
) -> Float[np.ndarray, "N"]:
    """The cosine between each picture (values in [0, 1]) and ``text``; the model is loaded for this
    and freed.
    """
    scores = PictureText(source, device).similarities(pictures, text, batch=batch)
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
        pixels = torch.nn.functional.interpolate(
            pixels, (size, size), mode="bicubic", antialias=True
        ).clamp(0, 1)
    return (pixels - torch.tensor(MEAN)[:, None, None]) / torch.tensor(STD)[:, None, None]
