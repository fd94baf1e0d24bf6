"""Running a model's text encoder: CLIP for Stable Diffusion, T5 for DeepFloyd IF. It is loaded,
used once, and freed.

Both follow diffusers' own pipelines: padded to the model's length, too long texts cut with a
warning, no gradients, float32 out."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..host import get_device, warn
from .extras import require_extra
from .model_files import free_memory, load_network, load_settings

LENGTH = 77
"""Tokens that CLIP, and DeepFloyd IF with its T5, were trained with."""


def encode_clip(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """The last hidden states of Stable Diffusion's text encoder, float32 on the CPU, one (N, F) per
    text.
    """
    from transformers import CLIPTextModel

    tokenizer = _tokenizer(folder)
    tokens = _tokenize(tokenizer, texts, min(tokenizer.model_max_length, LENGTH))

    def run(device: torch.device) -> Tensor:
        encoder = load_network(CLIPTextModel, folder, "text_encoder", dtype=torch.float32).to(
            device
        )
        # some models were trained to ignore the padding, most (all of Stable Diffusion's) to see it
        mask = (
            tokens.attention_mask.to(device)
            if getattr(encoder.config, "use_attention_mask", False)
            else None
        )
        return encoder(tokens.input_ids.to(device), attention_mask=mask)[0].float().cpu()

    return list(_freed(run))


def encode_t5(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """The last hidden states of DeepFloyd IF's T5 encoder, float32 on the CPU, one (77, F) per
    text.

    In half precision on a GPU, where nothing else is loaded yet: IF's encoder then takes about 11
      GB, in float32 19 GB.
    """
    require_extra(
        "diffusion", "sentencepiece", "google.protobuf"
    )  # without them transformers takes the tokenizer for another kind
    from transformers import T5EncoderModel

    tokenizer = _tokenizer(folder)
    # as in diffusers' IFPipeline without caption cleaning
    tokens = _tokenize(tokenizer, [text.lower().strip() for text in texts], LENGTH)

    def run(device: torch.device) -> Tensor:
        half = device.type == "cuda"
        dtype = torch.float16 if half else torch.float32
        encoder = load_network(T5EncoderModel, folder, "text_encoder", half=half, dtype=dtype).to(
            device
        )
        return (
            encoder(tokens.input_ids.to(device), attention_mask=tokens.attention_mask.to(device))[0]
            .float()
            .cpu()
        )

    return list(_freed(run))


def _tokenizer(folder: Path) -> Any:
    from transformers import AutoTokenizer

    # unless told not to, transformers would offer to run code that lies in the folder
    return load_settings(AutoTokenizer, folder, "tokenizer", trust_remote_code=False)


def _tokenize(tokenizer: Any, texts: list[str], length: int) -> Any:
    for text in texts:
        count = len(tokenizer(text, verbose=False).input_ids)
        if count > length:
            warn(
                f"the prompt has {count} tokens, the text encoder takes {length}: what comes "
                f"last has no effect: {text!r}"
            )
    return tokenizer(
        texts, padding="max_length", max_length=length, truncation=True, return_tensors="pt"
    )


@torch.no_grad()
def _freed(run: Callable[[torch.device], Tensor]) -> Tensor:
    """``run`` on this run's device, or on the CPU when the GPU's memory doesn't suffice; what it
    loaded is gone afterwards.
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
