"""Sizes of published models, from the ``config.json`` files of their components."""

from typing import Any, NamedTuple

from tests.helpers.tiny_models import STABLE_DIFFUSION_2_1
from threestudio_gaussiandreamer.models.multiview_unet import unet_options

CLIP_L = {
    "hidden_size": 768,
    "intermediate_size": 3072,
    "num_hidden_layers": 12,
    "num_attention_heads": 12,
    "projection_dim": 768,
}
OPENCLIP_H = {
    "hidden_size": 1024,
    "intermediate_size": 4096,
    "num_hidden_layers": 23,
    "num_attention_heads": 16,
    "projection_dim": 512,
}
OPENCLIP_BIG_G = {
    "hidden_size": 1280,
    "intermediate_size": 5120,
    "num_hidden_layers": 32,
    "num_attention_heads": 20,
    "projection_dim": 1280,
}
T5_XXL = {
    "vocab_size": 32128,
    "d_model": 4096,
    "d_kv": 64,
    "d_ff": 10240,
    "num_layers": 24,
    "num_heads": 64,
    "feed_forward_proj": "gated-gelu",
    "tie_word_embeddings": False,
}
STABLE_DIFFUSION_XL = {
    "sample_size": 128,
    "block_out_channels": (320, 640, 1280),
    "layers_per_block": 2,
    "down_block_types": ("DownBlock2D", "CrossAttnDownBlock2D", "CrossAttnDownBlock2D"),
    "up_block_types": ("CrossAttnUpBlock2D", "CrossAttnUpBlock2D", "UpBlock2D"),
    "transformer_layers_per_block": (1, 2, 10),
    "attention_head_dim": (5, 10, 20),
    "cross_attention_dim": 2048,
    "use_linear_projection": True,
    "addition_embed_type": "text_time",
    "addition_time_embed_dim": 256,
    "projection_class_embeddings_input_dim": 2816,
}
STABLE_DIFFUSION_3_5_MEDIUM = {
    "sample_size": 128,
    "num_layers": 24,
    "num_attention_heads": 24,
    "attention_head_dim": 64,
    "joint_attention_dim": 4096,
    "caption_projection_dim": 1536,
    "pooled_projection_dim": 2048,
    "pos_embed_max_size": 384,
    "dual_attention_layers": tuple(range(13)),
    "qk_norm": "rms_norm",
}
STABLE_DIFFUSION_3_5_LARGE = STABLE_DIFFUSION_3_5_MEDIUM | {
    "num_layers": 38,
    "num_attention_heads": 38,
    "caption_projection_dim": 2432,
    "pos_embed_max_size": 192,
    "dual_attention_layers": (),
}
MVDREAM = {
    "image_size": 32,
    "in_channels": 4,
    "out_channels": 4,
    "model_channels": 320,
    "attention_resolutions": [4, 2, 1],
    "num_res_blocks": 2,
    "channel_mult": [1, 2, 4, 4],
    "num_head_channels": 64,
    "transformer_depth": 1,
    "context_dim": 1024,
    "camera_dim": 16,
}
VAE = {
    "block_out_channels": (128, 256, 512, 512),
    "layers_per_block": 2,
    "down_block_types": ("DownEncoderBlock2D",) * 4,
    "up_block_types": ("UpDecoderBlock2D",) * 4,
    "latent_channels": 4,
}
FLOW_VAE = VAE | {
    "latent_channels": 16,
    "use_quant_conv": False,
    "use_post_quant_conv": False,
}


class Model(NamedTuple):
    """A published model and the size at which its configuration uses it."""

    network: str
    """Class of the network in diffusers."""
    options: dict[str, Any]
    vae: dict[str, Any]
    clips: tuple[dict[str, Any], ...]
    t5: bool
    side: int
    """Height and width of the guided image, pixels."""
    vae_bytes: int = 2
    """Bytes per number in the VAE."""


UNET, TRANSFORMER = "UNet2DConditionModel", "SD3Transformer2DModel"
SD2 = STABLE_DIFFUSION_2_1.unet | {"cross_attention_dim": 1024, "use_linear_projection": True}
TWO_CLIPS = (CLIP_L, OPENCLIP_BIG_G)
MODELS = {
    "Stable Diffusion 2.1": Model(UNET, SD2, VAE, (OPENCLIP_H,), False, 512),
    "Stable Diffusion XL": Model(UNET, STABLE_DIFFUSION_XL, VAE, TWO_CLIPS, False, 1024, 4),
    "Stable Diffusion 3.5 medium": Model(
        TRANSFORMER, STABLE_DIFFUSION_3_5_MEDIUM, FLOW_VAE, TWO_CLIPS, True, 512
    ),
    "Stable Diffusion 3.5 large": Model(
        TRANSFORMER, STABLE_DIFFUSION_3_5_LARGE, FLOW_VAE, TWO_CLIPS, True, 512
    ),
    "MVDream": Model(UNET, unet_options(MVDREAM), VAE, (OPENCLIP_H,), False, 256),
}
