"""Encode texts with the two or three text encoders of Stable Diffusion XL and 3.

These models are conditioned on the tokens of a text and on one vector for the whole text, the
pooled embedding. Both are kept in one tensor, the vector as a last token that is padded with zeros
(:func:`pack`), so that caching, view-dependent prompts and Perp-Neg treat them alike.

As in diffusers' pipelines, CLIP's tokens are the states before its last layer."""

import json
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .text_encoders import clip_tokens, t5_states, with_encoder

T5_LENGTH = 256
"""Number of tokens that Stable Diffusion 3's pipeline takes from T5."""
T5_WIDTH = 4096
SUFFIXES = ("", "_2")
"""Suffixes of the components of the two CLIP encoders."""


def pack(tokens: Float[Tensor, "*B N F"], vector: Float[Tensor, "*B P"]) -> Float[Tensor, "*B M F"]:
    """Append a vector of P <= F numbers to the tokens: M = N + 1."""
    padded = F.pad(vector, (0, tokens.shape[-1] - vector.shape[-1]))
    return torch.cat([tokens, padded[..., None, :].to(tokens)], dim=-2)


def unpack(
    packed: Float[Tensor, "*B M F"], width: int
) -> tuple[Float[Tensor, "*B N F"], Float[Tensor, "*B P"]]:
    """Return the tokens and the vector of ``width`` numbers that :func:`pack` appended."""
    return packed[..., :-1, :], packed[..., -1, :width]


def encode_sdxl(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the embeddings of Stable Diffusion XL, one (78, 2048) per text, float32 on the CPU:
    the tokens of both encoders side by side, and the pooled embedding of the second.
    """
    from transformers import CLIPTextModel, CLIPTextModelWithProjection

    classes = (CLIPTextModel, CLIPTextModelWithProjection)
    (first, _), (second, pooled) = (
        _clip(folder, suffix, texts, encoder)
        for suffix, encoder in zip(SUFFIXES, classes, strict=True)
    )
    return list(pack(torch.cat([first, second], dim=-1), pooled))


def encode_sd3(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the embeddings of Stable Diffusion 3, one (334, 4096) per text, float32 on the CPU:
    the tokens of both CLIP encoders side by side, padded to T5's width, then T5's; and the pooled
    embeddings of both CLIP encoders.
    """
    states = t5_states(folder, texts, suffix="_3", length=T5_LENGTH, uses_mask=False)
    return _sd3_embeddings(folder, texts, states)


def encode_sd3_without_t5(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the embeddings of Stable Diffusion 3 with zeros in place of T5's tokens, as diffusers'
    pipeline does without its third encoder.
    """
    width = _joint_width(folder)
    return _sd3_embeddings(folder, texts, torch.zeros(len(texts), T5_LENGTH, width))


def _sd3_embeddings(
    folder: Path, texts: list[str], states: Float[Tensor, "T L F"]
) -> list[Float[Tensor, "N F"]]:
    from transformers import CLIPTextModelWithProjection

    parts = [_clip(folder, suffix, texts, CLIPTextModelWithProjection) for suffix in SUFFIXES]
    tokens = torch.cat([tokens for tokens, _ in parts], dim=-1)
    tokens = F.pad(tokens, (0, states.shape[-1] - tokens.shape[-1]))
    pooled = torch.cat([vector for _, vector in parts], dim=-1)
    return list(pack(torch.cat([tokens, states], dim=1), pooled))


def _joint_width(folder: Path) -> int:
    """Return the width of the embeddings that the model takes; that of the published models if the
    settings of its network aren't in ``folder``.
    """
    settings = folder / "transformer" / "config.json"
    if not settings.is_file():
        return T5_WIDTH
    return json.loads(settings.read_text(encoding="utf-8"))["joint_attention_dim"]


def _clip(
    folder: Path, suffix: str, texts: list[str], encoder_class: Any
) -> tuple[Float[Tensor, "T N F"], Float[Tensor, "T P"]]:
    """Return tokens and pooled embeddings of one CLIP encoder, one text at a time, so that the
    result doesn't depend on the other texts.
    """
    ids = clip_tokens(folder, texts, suffix).input_ids

    def run(encoder: Any) -> tuple[Tensor, Tensor]:
        found = [encoder(row.to(encoder.device), output_hidden_states=True) for row in ids.split(1)]
        tokens = torch.cat([states.hidden_states[-2] for states in found])
        # of an encoder without projection, whose pooled embedding isn't used, the first output is
        # the last layer
        pooled = torch.cat([states[0].flatten(1) for states in found])
        return tokens.float().cpu(), pooled.float().cpu()

    return with_encoder(encoder_class, folder, f"text_encoder{suffix}", run)
