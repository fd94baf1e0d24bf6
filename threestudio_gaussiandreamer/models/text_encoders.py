"""Encode texts with a model's text encoder: CLIP for Stable Diffusion, T5 for DeepFloyd IF. The
encoder is loaded for one call and freed; CLIP's, which is small, is kept where ``loaded.py`` keeps
networks.

As in diffusers' pipelines, texts are padded to the model's length, and longer ones truncated with a
warning. The result is float32, without gradients."""

import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.extras import require_extra
from ..host import get_device, warn
from .loaded import loaded
from .model_files import free_memory, load_network, load_settings

LENGTH = 77
"""Number of tokens that CLIP, and DeepFloyd IF with T5, were trained with."""
SHOWN = 300
"""Characters of a prompt in a warning."""


def encode_clip(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the last hidden states of Stable Diffusion's text encoder, one (N, F) per text,
    float32 on the CPU.
    """
    from transformers import CLIPTextModel

    tokens = clip_tokens(folder, texts)

    def run(encoder: Any) -> Tensor:
        # Some models were trained with a mask that hides the padding; most, including all of Stable
        # Diffusion's, were trained without.
        uses_mask = getattr(encoder.config, "use_attention_mask", False)
        return _one_by_one(encoder, tokens, uses_mask=uses_mask)

    return list(with_encoder(CLIPTextModel, folder, "text_encoder", run))


def encode_t5(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the last hidden states of DeepFloyd IF's T5 encoder, one (77, F) per text, float32 on
    the CPU.
    """
    # as in diffusers' IFPipeline without caption cleaning
    return list(t5_states(folder, [text.lower().strip() for text in texts], length=LENGTH))


def clip_tokens(folder: Path, texts: list[str], suffix: str = "") -> Any:
    """Return the output of a CLIP tokenizer, that of the component "tokenizer" and ``suffix``."""
    component = f"tokenizer{suffix}"
    tokenizer = loaded((component, str(folder)), lambda: _tokenizer(folder, component))
    return _tokenize(tokenizer, texts, min(tokenizer.model_max_length, LENGTH))


def with_encoder(
    encoder_class: Any, folder: Path, component: str, run: Callable[[Any], Any]
) -> Any:
    """Load a CLIP text encoder in float32, call ``run`` with it, and free it."""

    def on_device(device: torch.device) -> Any:
        def load() -> Any:
            network = load_network(encoder_class, folder, component, dtype=torch.float32)
            return network.to(device)

        return run(loaded((component, str(folder), device), load))

    return _freed(on_device)


def t5_states(
    folder: Path, texts: list[str], *, suffix: str = "", length: int, uses_mask: bool = True
) -> Float[Tensor, "T N F"]:
    """Return the last hidden states of the T5 encoder that is the component "text_encoder" and
    ``suffix``, float32 on the CPU.

    On a GPU the encoder runs in half precision and takes about 11 GB; float32 takes 19 GB.

    Args:
        length: number of tokens.
        uses_mask: hide the padding, as the model was trained.
    """
    require_extra(
        "diffusion", "sentencepiece", "google.protobuf"
    )  # without these modules transformers chooses another tokenizer class
    from transformers import T5EncoderModel

    tokens = _tokenize(_tokenizer(folder, f"tokenizer{suffix}"), texts, length)

    def run(device: torch.device) -> Tensor:
        half = device.type == "cuda"
        dtype = torch.float16 if half else torch.float32
        encoder = load_network(
            T5EncoderModel, folder, f"text_encoder{suffix}", half=half, dtype=dtype
        ).to(device)
        return _one_by_one(encoder, tokens, uses_mask=uses_mask)

    return _freed(run)


def _one_by_one(encoder: Any, tokens: Any, *, uses_mask: bool) -> Float[Tensor, "T N F"]:
    """Encode each text by itself: in a batch its last bits would depend on the other texts, so on
    which ones are in the cache already.
    """
    found = []
    for ids, mask in zip(tokens.input_ids.split(1), tokens.attention_mask.split(1), strict=True):
        attention = mask.to(encoder.device) if uses_mask else None
        found.append(encoder(ids.to(encoder.device), attention_mask=attention)[0].float().cpu())
    return torch.cat(found)


def _tokenizer(folder: Path, component: str) -> Any:
    from transformers import AutoTokenizer

    # without this argument transformers asks whether to run code from the folder
    return load_settings(AutoTokenizer, folder, component, trust_remote_code=False)


def _tokenize(tokenizer: Any, texts: list[str], length: int) -> Any:
    for text in texts:
        count = len(tokenizer(text, verbose=False).input_ids)
        if count > length:
            warn(
                f"the prompt has {count} tokens, the text encoder takes {length}: what comes "
                f"last has no effect: {textwrap.shorten(text, SHOWN)!r}"
            )
    return tokenizer(
        texts, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
    )


@torch.no_grad()
def _freed(run: Callable[[torch.device], Any]) -> Any:
    """Call ``run`` with this run's device, or with the CPU if the GPU's memory doesn't suffice;
    free its memory afterwards.
    """
    device = get_device()
    try:
        return run(device)
    except torch.OutOfMemoryError:
        warn(
            "the text encoder doesn't fit into the GPU's memory and runs on the CPU, once: "
            "this can take minutes"
        )
        return run(torch.device("cpu"))
    finally:
        free_memory()
