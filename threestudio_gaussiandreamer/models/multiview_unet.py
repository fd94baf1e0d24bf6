"""Load the UNet of MVDream (Shi et al. 2023) from the folders of its conversions to diffusers'
format, such as ``ashawkey/mvdream-sd2.1-diffusers``, whose code isn't run. It is Stable Diffusion's
in the naming of CompVis's latent-diffusion, with two additions; diffusers' UNet computes it:

* an embedding of the camera, added to that of the timestep: a "projection" class embedding;
* self-attention over all views of an object together."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.utils.hooks import RemovableHandle

from .model_files import component_weights, files_below, loading_errors

CAMERA = 16
"""Numbers of a camera: its matrix from camera to world, by rows."""
LDM_PREFIX = "model.diffusion_model."


def load_multiview_unet(
    unet_class: Any, folder: Path, component: str, *, half: bool, torch_dtype: torch.dtype
) -> nn.Module:
    """Load the network as diffusers' UNet; its cameras are ``class_labels`` (B, 16)."""
    from diffusers.loaders.single_file_utils import convert_ldm_unet_checkpoint
    from safetensors.torch import load_file

    weights = component_weights(files_below(folder), component, half=half)
    with loading_errors(f"{component} of the model in {str(folder)!r}"):
        settings = json.loads((folder / component / "config.json").read_text(encoding="utf-8"))
        options = unet_options(settings)
        with torch.device("meta"):
            unet = unet_class(**options)
        named = {}
        for file in weights.files:
            for name, value in load_file(folder / file).items():
                # the camera's embedding is the class embedding, which diffusers converts
                name = LDM_PREFIX + name.replace("camera_embed.", "label_emb.0.")
                named[name] = value.to(torch_dtype)
        unet.load_state_dict(convert_ldm_unet_checkpoint(named, options), assign=True)
    return unet.eval()


def unet_options(settings: dict[str, Any]) -> dict[str, Any]:
    """Convert the settings of a ``MultiViewUNetModel`` to those of diffusers' UNet."""
    channels = [settings["model_channels"] * factor for factor in settings["channel_mult"]]
    attends = [2**level in settings["attention_resolutions"] for level in range(len(channels))]
    kinds, width = [a * "CrossAttn" for a in attends], settings.get("num_head_channels", -1)
    heads = [settings["num_heads"] if width == -1 else channel // width for channel in channels]
    return {
        "sample_size": settings["image_size"],
        "in_channels": settings["in_channels"],
        "out_channels": settings["out_channels"],
        "block_out_channels": channels,
        "layers_per_block": settings["num_res_blocks"],
        "down_block_types": [f"{kind}DownBlock2D" for kind in kinds],
        "up_block_types": [f"{kind}UpBlock2D" for kind in reversed(kinds)],
        "attention_head_dim": heads,  # diffusers' name for the number of heads
        "cross_attention_dim": settings["context_dim"],
        "transformer_layers_per_block": settings.get("transformer_depth", 1),
        "use_linear_projection": True,
        "class_embed_type": "projection",
        "projection_class_embeddings_input_dim": CAMERA,
    }


@contextlib.contextmanager
def views_attended_together(unet: nn.Module, views: int) -> Iterator[None]:
    """Do as :func:`attend_across_views` within a ``with`` block; nothing for one view."""
    with contextlib.ExitStack() as stack:
        for hook in attend_across_views(unet, views) if views > 1 else ():
            stack.enter_context(hook)
        yield


def attend_across_views(unet: nn.Module, views: int) -> list[RemovableHandle]:
    """Let every self-attention of a UNet see the tokens of ``views`` consecutive rows together:
    hooks join those (R, L, F) to (R / views, views L, F) before it, and part them after it.
    """

    def join(module: nn.Module, args: tuple[Any, ...]) -> tuple[Any, ...]:
        return args[0].unflatten(0, (-1, views)).flatten(1, 2), *args[1:]

    def part(module: nn.Module, args: tuple[Any, ...], output: Tensor) -> Tensor:
        return output.unflatten(1, (views, -1)).flatten(0, 1)

    return [
        hook
        for name, module in unet.named_modules()
        if name.endswith(".attn1")
        for hook in (module.register_forward_pre_hook(join), module.register_forward_hook(part))
    ]
