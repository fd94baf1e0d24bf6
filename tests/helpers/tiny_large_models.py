"""Tiny Stable Diffusion XL, Stable Diffusion 3 and MVDream with random weights, each in a folder
laid out as the published one (``tiny_models.py``).
"""

import json
from pathlib import Path
from typing import Any

import torch
from torch import nn

from tests.helpers.tiny_models import (
    TINY,
    clip_text_encoder,
    listen_to_text,
    stable_diffusion,
    t5_text_encoder,
    vae,
    write_index,
    write_json,
)

CLIP_WIDTHS = (32, 32)
"""Widths of the tokens of the two CLIP encoders."""
T5_WIDTH = 96
POOLED = 16
"""Width of the pooled embedding of each CLIP encoder."""
MULTI_VIEW = dict(
    image_size=8, in_channels=4, out_channels=4, model_channels=32, attention_resolutions=[2, 1],
    num_res_blocks=1, channel_mult=[1, 2], num_head_channels=16, transformer_depth=1,
    context_dim=32, camera_dim=16,
)  # fmt: skip
"""Settings of the tiny MVDream; the published ones have the same names."""


def stable_diffusion_xl(folder: Path, *, seed: int = 0, force_upcast: bool = True) -> Path:
    """Write a tiny Stable Diffusion XL base: UNet on 8x8x4 latents, two CLIP encoders."""
    from diffusers import EulerDiscreteScheduler, UNet2DConditionModel

    torch.manual_seed(seed)
    unet = UNet2DConditionModel(
        **TINY.unet,
        cross_attention_dim=sum(CLIP_WIDTHS),
        use_linear_projection=True,
        addition_embed_type="text_time",
        addition_time_embed_dim=8,
        projection_class_embeddings_input_dim=6 * 8 + POOLED,
    )
    listen_to_text(unet)
    unet.save_pretrained(folder / "unet")
    vae(folder, latent_channels=4, scaling_factor=0.13025, force_upcast=force_upcast)
    clip_text_encoder(folder, CLIP_WIDTHS[0])
    clip_text_encoder(folder, CLIP_WIDTHS[1], suffix="_2", projection=POOLED)
    betas = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
    EulerDiscreteScheduler(**betas, steps_offset=1).save_pretrained(folder / "scheduler")
    components = {"unet": "UNet2DConditionModel", "vae": "AutoencoderKL"}
    components |= {"text_encoder": "CLIPTextModel", "text_encoder_2": "CLIPTextModelWithProjection"}
    components |= dict.fromkeys(("tokenizer", "tokenizer_2"), "CLIPTokenizer")
    components |= {"scheduler": "EulerDiscreteScheduler"}
    zeros = {"force_zeros_for_empty_prompt": True}
    return write_index(folder, "StableDiffusionXLPipeline", components, **zeros)


def stable_diffusion_3(folder: Path, *, seed: int = 0) -> Path:
    """Write a tiny Stable Diffusion 3: transformer on 8x8x16 latents, two CLIP encoders and T5."""
    from diffusers import FlowMatchEulerDiscreteScheduler, SD3Transformer2DModel

    torch.manual_seed(seed)
    transformer = SD3Transformer2DModel(
        sample_size=8, patch_size=2, in_channels=16, num_layers=2, attention_head_dim=8,
        num_attention_heads=4, joint_attention_dim=T5_WIDTH, caption_projection_dim=32,
        pooled_projection_dim=2 * POOLED, out_channels=16, pos_embed_max_size=12,
    )  # fmt: skip
    listen_to_text(transformer)
    transformer.save_pretrained(folder / "transformer")
    quant = {"use_quant_conv": False, "use_post_quant_conv": False}
    vae(folder, latent_channels=16, scaling_factor=1.5305, shift_factor=0.0609, **quant)
    for suffix, width in zip(("", "_2"), CLIP_WIDTHS, strict=True):
        clip_text_encoder(folder, width, suffix=suffix, projection=POOLED)
    t5_text_encoder(folder, T5_WIDTH, suffix="_3")
    FlowMatchEulerDiscreteScheduler(shift=3.0).save_pretrained(folder / "scheduler")
    components = {"transformer": "SD3Transformer2DModel", "vae": "AutoencoderKL"}
    clip = ("text_encoder", "text_encoder_2"), "CLIPTextModelWithProjection"
    components |= dict.fromkeys(*clip) | {"text_encoder_3": "T5EncoderModel"}
    components |= dict.fromkeys(("tokenizer", "tokenizer_2"), "CLIPTokenizer")
    components |= {"tokenizer_3": "T5Tokenizer", "scheduler": "FlowMatchEulerDiscreteScheduler"}
    return write_index(folder, "StableDiffusion3Pipeline", components)


def mvdream(folder: Path, *, seed: int = 0, **settings: Any) -> Path:
    """Write a tiny MVDream in the layout of its conversion: Stable Diffusion 2.1, its UNet in
    CompVis's names with cameras, and the code of that UNet, which must not run.
    """
    from safetensors.torch import save_file

    from threestudio_gaussiandreamer.models.multiview_unet import unet_options

    stable_diffusion(folder, seed=seed)
    unet = plain_unet(unet_options(MULTI_VIEW), seed)
    for file in (folder / "unet").iterdir():
        file.unlink()
    tensors = {compvis_name(name, MULTI_VIEW): value for name, value in unet.state_dict().items()}
    save_file(tensors, folder / "unet" / "diffusion_pytorch_model.safetensors")
    named = {"_class_name": "MultiViewUNetModel"}
    write_json(folder / "unet" / "config.json", named | MULTI_VIEW | settings)
    (folder / "unet" / "mv_unet.py").write_text("raise SystemExit('this code must not run')\n")
    index = json.loads((folder / "model_index.json").read_text())
    index |= {"_class_name": "MVDreamPipeline", "unet": ["mv_unet", "MultiViewUNetModel"]}
    write_json(folder / "model_index.json", index)
    return folder


def plain_unet(options: dict[str, Any], seed: int = 0) -> nn.Module:
    """Make diffusers' UNet with these options and random weights."""
    from diffusers import UNet2DConditionModel

    torch.manual_seed(seed)
    unet = UNet2DConditionModel(**options)
    listen_to_text(unet)
    return unet.eval()


RESNET = {
    "norm1": "in_layers.0",
    "conv1": "in_layers.2",
    "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0",
    "conv2": "out_layers.3",
    "conv_shortcut": "skip_connection",
}
OUTER = {
    "time_embedding.linear_1": "time_embed.0",
    "time_embedding.linear_2": "time_embed.2",
    "class_embedding.linear_1": "camera_embed.0",
    "class_embedding.linear_2": "camera_embed.2",
    "conv_in": "input_blocks.0.0",
    "conv_norm_out": "out.0",
    "conv_out": "out.2",
}


def compvis_name(name: str, settings: dict[str, Any]) -> str:
    """Return the name in CompVis's latent-diffusion of a parameter of diffusers' UNet."""
    outer, _, last = name.rpartition(".")
    if outer in OUTER:
        return f"{OUTER[outer]}.{last}"
    part, *path = name.split(".")
    layers = settings["num_res_blocks"] + 1
    if part == "mid_block":
        kind, index, *rest = path
        return f"middle_block.{1 if kind == 'attentions' else 2 * int(index)}.{_inner(kind, rest)}"
    block, kind, index, *rest = path
    first = int(block) * layers
    if kind == "downsamplers":
        return f"input_blocks.{first + layers}.0.op.{rest[-1]}"
    side, first = ("input_blocks", first + 1) if part == "down_blocks" else ("output_blocks", first)
    if kind == "upsamplers":
        return f"{side}.{first + layers - 1}.2.conv.{rest[-1]}"  # after a resnet and an attention
    return f"{side}.{first + int(index)}.{int(kind == 'attentions')}.{_inner(kind, rest)}"


def _inner(kind: str, rest: list[str]) -> str:
    return ".".join([RESNET[rest[0]], *rest[1:]] if kind == "resnets" else rest)
