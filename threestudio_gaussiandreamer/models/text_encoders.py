"""Encode texts with a model's text encoders: CLIP for Stable Diffusion, T5 for DeepFloyd IF, two or
three encoders for Stable Diffusion XL and 3. An encoder is loaded for one call and freed; CLIP's,
which are small, are kept where ``model_files.py`` keeps networks. As in diffusers, texts are
padded to the model's length, and longer ones truncated with a warning. The result is float32 on the
CPU; the pooled embedding of Stable Diffusion XL and 3 is a last token (:func:`pack`)."""

import hashlib
import json
import textwrap
from collections.abc import Callable
from pathlib import Path
from typing import Any, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..core.extras import require_extra
from ..core.files import output_folder, write_file
from ..host import debug, get_device, warn
from .model_files import free_memory, load_network, load_settings, loaded

LENGTH = 77
"""Number of tokens that CLIP, and DeepFloyd IF with T5, were trained with."""
SHOWN = 300
"""Characters of a prompt in a warning."""
T5_LENGTH = 256
"""Number of tokens that Stable Diffusion 3's pipeline takes from T5."""
T5_WIDTH = 4096
CACHE_FORMAT = 1
"""Part of the cache's key: increase it when the output for the same model and text changes."""


def encode_clip(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the last hidden states of Stable Diffusion's text encoder, one (N, F) per text."""
    from transformers import CLIPTextModel

    tokens = clip_tokens(folder, texts)

    def run(encoder: Any) -> Tensor:
        # few models, none of Stable Diffusion's, were trained with a mask that hides the padding
        uses_mask = getattr(encoder.config, "use_attention_mask", False)
        return _one_by_one(encoder, tokens, uses_mask=uses_mask)

    return list(with_encoder(CLIPTextModel, folder, "text_encoder", run))


def encode_t5(folder: Path, texts: list[str]) -> list[Float[Tensor, "N F"]]:
    """Return the last hidden states of DeepFloyd IF's T5 encoder, one (77, F) per text."""
    # as in diffusers' IFPipeline without caption cleaning
    return list(t5_states(folder, [text.lower().strip() for text in texts], length=LENGTH))


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
    """Return the embeddings of Stable Diffusion XL, one (78, 2048) per text: the tokens of both
    encoders side by side, and the pooled embedding of the second.
    """
    from transformers import CLIPTextModel, CLIPTextModelWithProjection

    first, _ = _clip(folder, "", texts, CLIPTextModel)
    second, pooled = _clip(folder, "_2", texts, CLIPTextModelWithProjection)
    return list(pack(torch.cat([first, second], dim=-1), pooled))


def encode_sd3(
    folder: Path, texts: list[str], *, use_t5: bool = True
) -> list[Float[Tensor, "N F"]]:
    """Return the embeddings of Stable Diffusion 3, one (334, 4096) per text: the tokens of both
    CLIP encoders side by side, padded to T5's width, then T5's, or zeros, as in diffusers' pipeline
    without its third encoder; and their pooled embeddings.
    """
    from transformers import CLIPTextModelWithProjection

    if use_t5:
        states = t5_states(folder, texts, suffix="_3", length=T5_LENGTH, uses_mask=False)
    else:
        settings, width = folder / "transformer" / "config.json", T5_WIDTH
        if settings.is_file():
            width = json.loads(settings.read_text(encoding="utf-8"))["joint_attention_dim"]
        states = torch.zeros(len(texts), T5_LENGTH, width)
    parts = [_clip(folder, suffix, texts, CLIPTextModelWithProjection) for suffix in ("", "_2")]
    tokens = torch.cat([tokens for tokens, _ in parts], dim=-1)
    tokens = F.pad(tokens, (0, states.shape[-1] - tokens.shape[-1]))
    pooled = torch.cat([vector for _, vector in parts], dim=-1)
    return list(pack(torch.cat([tokens, states], dim=1), pooled))


def _clip(
    folder: Path, suffix: str, texts: list[str], encoder_class: Any
) -> tuple[Float[Tensor, "T N F"], Float[Tensor, "T P"]]:
    """Return the states before the last layer and the pooled embeddings of one CLIP encoder."""
    ids = clip_tokens(folder, texts, suffix).input_ids

    def run(encoder: Any) -> tuple[Tensor, Tensor]:
        found = [encoder(row.to(encoder.device), output_hidden_states=True) for row in ids.split(1)]
        tokens = torch.cat([states.hidden_states[-2] for states in found])
        # without projection, where it isn't used, the first output is the last layer
        pooled = torch.cat([states[0].flatten(1) for states in found])
        return tokens.float().cpu(), pooled.float().cpu()

    return with_encoder(encoder_class, folder, f"text_encoder{suffix}", run)


def clip_tokens(folder: Path, texts: list[str], suffix: str = "") -> Any:
    """Return the output of a CLIP tokenizer, that of the component "tokenizer" and ``suffix``."""
    component = f"tokenizer{suffix}"
    tokenizer = loaded((component, str(folder)), lambda: _tokenizer(folder, component))
    return _tokenize(tokenizer, texts, min(tokenizer.model_max_length, LENGTH))


def with_encoder(kind: Any, folder: Path, component: str, run: Callable[[Any], Any]) -> Any:
    """Load a CLIP text encoder in float32, call ``run`` with it, and free it."""

    def load(device: torch.device) -> Any:
        return load_network(kind, folder, component, dtype=torch.float32).to(device)

    return _freed(lambda d: run(loaded((component, str(folder), d), lambda: load(d))))


def t5_states(
    folder: Path, texts: list[str], *, suffix: str = "", length: int, uses_mask: bool = True
) -> Float[Tensor, "T N F"]:
    """Return the last hidden states of a T5 encoder, of ``length`` tokens; on a GPU in half
    precision, which takes 11 of 19 GB. ``uses_mask``: hide the padding, as the model was trained.
    """
    # without these modules transformers chooses another tokenizer class
    require_extra("diffusion", "sentencepiece", "google.protobuf")
    from transformers import T5EncoderModel

    tokens = _tokenize(_tokenizer(folder, f"tokenizer{suffix}"), texts, length)

    def run(device: torch.device) -> Tensor:
        half = device.type == "cuda"
        options = {"half": half, "dtype": torch.float16 if half else torch.float32}
        encoder = load_network(T5EncoderModel, folder, f"text_encoder{suffix}", **options)
        return _one_by_one(encoder.to(device), tokens, uses_mask=uses_mask)

    return _freed(run)


def _one_by_one(encoder: Any, tokens: Any, *, uses_mask: bool) -> Float[Tensor, "T N F"]:
    """Encode each text by itself: in a batch its last bits would depend on the other texts."""
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
    padded = {"padding": "max_length", "max_length": length, "truncation": True}
    return tokenizer(texts, **padded, return_tensors="pt")


@torch.no_grad()
def _freed(run: Callable[[torch.device], Any]) -> Any:
    """Call ``run`` with this run's device, or the CPU if the GPU's memory doesn't suffice."""
    device = get_device()
    try:
        return run(device)
    except torch.OutOfMemoryError:
        warn("the text encoder is too large for the GPU, and runs on the CPU, once, for minutes")
        return run(torch.device("cpu"))
    finally:
        free_memory()


def require_cache_folder(folder: str) -> Path:
    """Make the folder of embeddings; raise UserError if it can't be made or written."""
    return output_folder(folder, "system.prompt_processor.cache_dir, or set use_cache=false")


class EmbeddingCache:
    """The embeddings of one text encoder in ``folder``, a safetensors file per text; ``model`` is
    the ``model_files.fingerprint`` of it and its tokenizer.
    """

    def __init__(self, folder: str, model: str) -> None:
        self.folder, self.model = Path(folder).expanduser(), model

    def path(self, text: str) -> Path:
        key = json.dumps([CACHE_FORMAT, self.model, text])
        return self.folder / f"{hashlib.sha256(key.encode()).hexdigest()}.safetensors"

    def read(self, text: str) -> Optional[Float[Tensor, "N F"]]:
        """Return the embedding of ``text``; None if it isn't cached or its file is damaged."""
        from safetensors import SafetensorError
        from safetensors.torch import load

        path = self.path(text)
        try:
            return load(path.read_bytes())["embedding"]
        except FileNotFoundError:
            return None
        except (OSError, SafetensorError, KeyError, ValueError) as error:
            debug(f"the cached text embedding {path} can't be read and is made again: {error}")
            return None

    def write(self, text: str, embedding: Float[Tensor, "N F"]) -> None:
        """Store one embedding atomically; raise UserError if the folder can't be written."""
        from safetensors.torch import save

        require_cache_folder(self.folder)
        content = {"embedding": embedding.float().cpu().contiguous()}
        write_file(self.path(text), save(content, metadata={"text": text}))

    def embed(
        self, texts: list[str], encode: Callable[[list[str]], list[Any]]
    ) -> list[Float[Tensor, "N F"]]:
        """Return the embeddings of ``texts``; those that aren't cached are encoded and stored."""
        found = {text: self.read(text) for text in texts}
        missing = [text for text, embedding in found.items() if embedding is None]
        if missing:
            require_cache_folder(self.folder)  # before the encoder is loaded
            found |= zip(missing, encode(missing), strict=True)
        for text in missing:
            self.write(text, found[text])
        return [found[text] for text in texts]
