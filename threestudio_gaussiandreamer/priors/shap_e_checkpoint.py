"""Weights of Shap-E's text-to-latent model in OpenAI's own format, as Cap3D publishes its finetuned
ones, for diffusers.

The file is a state dict, or a dict with one under ``model_state_dict``. Its names are those of a
plain transformer inside a wrapper (``wrapped.``); diffusers' ``PriorTransformer`` is the same
network under other names, with query, key and value apart. Every name must be used and every
parameter filled: anything else is another model."""

import re

import torch
from torch import Tensor, nn

from ..core.errors import UserError
from .weights import load_exactly, named, read_state_dict

PREFIX = "wrapped."
RENAMED = (
    (r"time_embed\.c_fc\.", "time_embedding.linear_1."),
    (r"time_embed\.c_proj\.", "time_embedding.linear_2."),
    (r"clip_embed\.", "embedding_proj."),
    (r"input_proj\.", "proj_in."),
    (r"output_proj\.", "proj_to_clip_embeddings."),
    (r"ln_pre\.", "norm_in."),
    (r"ln_post\.", "norm_out."),
    (r"backbone\.resblocks\.(\d+)\.ln_1\.", r"transformer_blocks.\1.norm1."),
    (r"backbone\.resblocks\.(\d+)\.ln_2\.", r"transformer_blocks.\1.norm3."),
    (r"backbone\.resblocks\.(\d+)\.attn\.c_proj\.", r"transformer_blocks.\1.attn1.to_out.0."),
    (r"backbone\.resblocks\.(\d+)\.mlp\.c_fc\.", r"transformer_blocks.\1.ff.net.0.proj."),
    (r"backbone\.resblocks\.(\d+)\.mlp\.c_proj\.", r"transformer_blocks.\1.ff.net.2."),
)
"""Beginnings of OpenAI's names and of diffusers'; what follows ("weight", "bias") is the same."""
PACKED = re.compile(r"backbone\.resblocks\.(\d+)\.attn\.c_qkv\.(weight|bias)")
UNUSED_BY_SHAP_E = ("clip_mean", "clip_std")
"""Parameters that diffusers' class has for another model; Shap-E's checkpoint lacks them and its
sampling ignores them.
"""


def load_original_prior(prior: nn.Module, path: str) -> None:
    """Replace the weights of diffusers' ``prior`` by those of OpenAI's format in the file ``path``.

    Raises:
        UserError: the file can't be read, or its names or shapes are not those of this model.
    """
    state = read_state_dict(path, "Shap-E checkpoint")
    state = to_diffusers(state, prior.config.num_attention_heads)
    own = prior.state_dict()
    state.update({name: own[name] for name in UNUSED_BY_SHAP_E if name in own})
    load_exactly(prior, state, f"Shap-E checkpoint {path!r}")


def to_diffusers(state: dict[str, Tensor], heads: int) -> dict[str, Tensor]:
    """Convert OpenAI's names and layouts to those of ``PriorTransformer``.

    Raises:
        UserError: a name is none of Shap-E's text model.
    """
    converted: dict[str, Tensor] = {}
    unknown = []
    for name, value in state.items():
        known = name.startswith(PREFIX)
        parts = _converted(name.removeprefix(PREFIX), value, heads) if known else {}
        converted.update(parts)
        unknown += [] if parts else [name]
    if unknown:
        raise UserError(
            f"the checkpoint has {len(unknown)} names that are none of Shap-E's text model "
            f"({named(unknown)}): names like {PREFIX}backbone.resblocks.0.ln_1.weight were expected"
        )
    return converted


def _converted(name: str, value: Tensor, heads: int) -> dict[str, Tensor]:
    """Return what one entry becomes: one or three entries, or none for an unknown name."""
    if name == "pos_emb":
        return {"positional_embedding": value[None]}
    if packed := PACKED.fullmatch(name):
        block, kind = packed.groups()
        start = f"transformer_blocks.{block}.attn1"
        parts = zip(("to_q", "to_k", "to_v"), unpacked(value, heads), strict=True)
        return {f"{start}.{part}.{kind}": rows for part, rows in parts}
    for pattern, replacement in RENAMED:
        renamed, count = re.subn("^" + pattern + r"(?=(weight|bias)$)", replacement, name)
        if count:
            return {renamed: value}
    return {}


def unpacked(value: Tensor, heads: int) -> tuple[Tensor, ...]:
    """Query, key and value rows of a packed projection, whose rows are ordered head by head:
    (heads, 3, channels).
    """
    if len(value) % (3 * heads):
        raise UserError(
            f"the checkpoint packs query, key and value into {len(value)} rows, which are not "
            f"for {heads} heads"
        )
    rows = value.reshape(heads, 3, -1, *value.shape[1:])
    return tuple(torch.flatten(part, 0, 1) for part in rows.unbind(dim=1))
