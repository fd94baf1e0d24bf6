"""ImageReward (Xu et al. 2023): how well people like a picture for a prompt, by the published file
``ImageReward.pt``, run by transformers' BLIP: a ViT, a BERT that attends to it, and five linear
layers that map the first token's features to the reward, which is standardised to mean 0 and
deviation 1 over the pictures that it was trained on."""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.extras import require_extra
from ..models.clip import preprocessed
from ..models.model_files import load_exactly, read_state_dict

WEIGHTS, VOCABULARY = "ImageReward.pt", "vocab.txt"
SOURCES = {
    WEIGHTS: "hf download zai-org/ImageReward ImageReward.pt",
    VOCABULARY: "hf download google-bert/bert-base-uncased vocab.txt",
}
"""Commands that download the files, without the option for the folder."""
MEAN, DEVIATION = 0.16717362830052426, 1.0333394966054072
"""Of the head's output; published in ImageReward's code, not in its file."""
TOKENS, HEAD_WIDTH = 35, 64
"""Length of a prompt, padded and cut; features of one attention head."""
VISION, BLOCK = r"^blip\.visual_encoder\.", r"vision.encoder.layers.\1."
NAMES = (
    (VISION + "cls_token$", "vision.embeddings.class_embedding"),
    (VISION + "pos_embed$", "vision.embeddings.position_embedding"),
    (VISION + r"patch_embed\.proj", "vision.embeddings.patch_embedding"),
    (VISION + r"norm\.", "vision.post_layernorm."),
    (VISION + r"blocks\.(\d+)\.norm", BLOCK + "layer_norm"),
    (VISION + r"blocks\.(\d+)\.attn\.proj\.", BLOCK + "self_attn.projection."),
    (VISION + r"blocks\.(\d+)\.attn", BLOCK + "self_attn"),
    (VISION + r"blocks\.(\d+)\.", BLOCK),
    (r"^blip\.text_encoder\.", "text."),
    (r"^mlp\.layers\.", "head."),
)
"""Salesforce's names of tensors, and those here; the first that matches holds."""
NOT_LOADED = "text.embeddings.position_ids"


class RewardNetwork(nn.Module):
    """ViT, BERT with cross-attention, and head, of two configurations of transformers' BLIP."""

    def __init__(self, vision: Any, text: Any) -> None:
        super().__init__()
        from transformers import BlipTextModel, BlipVisionModel

        self.vision = BlipVisionModel(vision)
        self.text = BlipTextModel(text, add_pooling_layer=False)
        # with the numbers in the file, which counts dropout
        sizes = {0: (text.hidden_size, 1024), 2: (1024, 128), 4: (128, 64), 6: (64, 16), 7: (16, 1)}
        self.head = nn.ModuleDict({str(i): nn.Linear(*size) for i, size in sizes.items()})

    def forward(
        self, pixels: Float[Tensor, "B 3 S S"], ids: Tensor, mask: Tensor
    ) -> Float[Tensor, " B"]:
        """Return the rewards of pictures, normalised as for CLIP, for one prompt: (1, L) tokens."""
        features = self.vision(pixels).last_hidden_state
        count = len(features)
        found = self.text(
            input_ids=ids.expand(count, -1),
            attention_mask=mask.expand(count, -1),
            encoder_hidden_states=features,
            encoder_attention_mask=torch.ones(features.shape[:2], dtype=torch.long).to(mask),
        ).last_hidden_state[:, 0]
        for layer in self.head.values():
            found = layer(found)
        return (found[:, 0] - MEAN) / DEVIATION


class ImageReward:
    """ImageReward from a folder with ``ImageReward.pt`` and BERT's ``vocab.txt``."""

    def __init__(self, folder: str, device: torch.device) -> None:
        require_extra("diffusion", "transformers")
        place = Path(folder).expanduser()
        for name, command in SOURCES.items():
            if not (place / name).is_file():
                get = f"`{command} --local-dir {folder}`"
                raise UserError(f"--imagereward {folder}: {name} is missing: {get}")
        self.network = load_network(place / WEIGHTS).to(device)
        self.tokenizer, self.device = open_tokenizer(place / VOCABULARY), device
        self.size = self.network.vision.config.image_size

    @torch.no_grad()
    def rewards(
        self, pictures: Float[np.ndarray, "N H W 3"], prompt: str, *, batch: int = 32
    ) -> Float[np.ndarray, " N"]:
        """Return the reward of each picture (values in [0, 1]) for a prompt."""
        tokens = self.tokenizer.encode(prompt)
        ids, mask = torch.tensor([[tokens.ids], [tokens.attention_mask]], device=self.device)
        parts = np.array_split(pictures, -(-len(pictures) // batch))
        pixels = (preprocessed(part, self.size).to(self.device) for part in parts)
        return torch.cat([self.network(part, ids, mask) for part in pixels]).cpu().numpy()


def open_tokenizer(vocabulary: Path) -> Any:
    """Open BERT's tokenizer for lower-case text, which pads and cuts to ``TOKENS``."""
    from tokenizers import BertWordPieceTokenizer

    try:
        tokenizer = BertWordPieceTokenizer(str(vocabulary), lowercase=True)
        tokenizer.enable_padding(length=TOKENS, pad_id=tokenizer.token_to_id("[PAD]"))
    except Exception as error:  # tokenizers raises many kinds
        raise UserError(f"{str(vocabulary)!r} is no vocabulary of BERT: {error}") from error
    tokenizer.enable_truncation(TOKENS)
    return tokenizer


def load_network(path: Path) -> RewardNetwork:
    """Load the published file in float32 and evaluation mode."""
    kind = "ImageReward file"
    state = {}
    for name, value in read_state_dict(str(path), kind).items():
        for pattern, replacement in NAMES:
            if re.search(pattern, name):
                state[re.sub(pattern, replacement, name)] = value
                break
    state.pop(NOT_LOADED, None)
    try:
        network = RewardNetwork(*configurations(state))
    except (KeyError, IndexError, ValueError, RuntimeError, ZeroDivisionError) as error:
        said = f"no tensors, or misshapen ones, of a BLIP with a reward head ({error})"
        raise UserError(f"{kind} {str(path)!r}: it has {said}") from error
    load_exactly(network, state, f"{kind} {str(path)!r}")
    return network.float().eval()


def configurations(state: Mapping[str, Tensor]) -> tuple[Any, Any]:
    """Return the configurations of ViT and BERT that the shapes of the tensors imply."""
    from transformers import BlipTextConfig, BlipVisionConfig

    patch = state["vision.embeddings.patch_embedding.weight"]
    places = state["vision.embeddings.position_embedding"].shape[1] - 1
    words = state["text.embeddings.word_embeddings.weight"]
    vision = BlipVisionConfig(
        hidden_size=len(patch),
        intermediate_size=len(state["vision.encoder.layers.0.mlp.fc1.weight"]),
        num_hidden_layers=layers(state, "vision.encoder.layers."),
        num_attention_heads=len(patch) // HEAD_WIDTH,
        image_size=round(places**0.5) * patch.shape[-1],
        patch_size=patch.shape[-1],
        hidden_act="gelu",
        layer_norm_eps=1e-6,
    )
    text = BlipTextConfig(
        vocab_size=len(words),
        hidden_size=words.shape[1],
        encoder_hidden_size=len(patch),
        intermediate_size=len(state["text.encoder.layer.0.intermediate.dense.weight"]),
        num_hidden_layers=layers(state, "text.encoder.layer."),
        num_attention_heads=words.shape[1] // HEAD_WIDTH,
        max_position_embeddings=len(state["text.embeddings.position_embeddings.weight"]),
        hidden_act="gelu",
        layer_norm_eps=1e-12,
        is_decoder=True,  # with cross-attention
    )
    return vision, text


def layers(state: Mapping[str, Tensor], prefix: str) -> int:
    """Return the number of layers whose names begin with ``prefix`` and a number."""
    return len({name[len(prefix) :].split(".")[0] for name in state if name.startswith(prefix)})
