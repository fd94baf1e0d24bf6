"""Tiny models with random weights, laid out as the published ones in diffusers' format."""

import json
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import torch
from torch import nn

TEXT_WIDTH = 32
PUBLISHED_VAE_NAMES = {"to_q.": "query.", "to_k.": "key.", "to_v.": "value."}
PUBLISHED_VAE_NAMES |= {"to_out.0.": "proj_attn."}
"""The attention's names in Stable Diffusion's VAE files, which are older than today's."""
CORPUS = "a photo of an iron man fox corgi in the snow, side view front back overhead kicks "
CORPUS += "with his left leg, ugly blurry"


def nothing_cached(monkeypatch, folder: Path) -> None:
    """Hide the models in the hub's cache of this machine."""
    import huggingface_hub.constants

    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(folder / "empty"))


class Sizes(NamedTuple):
    """The sizes in which a tiny Stable Diffusion differs from the published one."""

    unet: dict[str, Any]
    vae: dict[str, Any]
    text_width: int


TINY = Sizes(
    unet=dict(
        sample_size=8, block_out_channels=(16, 32), layers_per_block=1, norm_num_groups=8,
        down_block_types=("CrossAttnDownBlock2D", "DownBlock2D"),
        up_block_types=("UpBlock2D", "CrossAttnUpBlock2D"), attention_head_dim=(2, 4),
    ),
    vae=dict(
        sample_size=64, block_out_channels=(8, 8, 16, 16), layers_per_block=1, norm_num_groups=4
    ),
    text_width=TEXT_WIDTH,
)  # fmt: skip


def stable_diffusion(folder: Path, *, prediction="epsilon", seed=0, sizes: Sizes = TINY) -> Path:
    """Write a tiny Stable Diffusion 2.1 on 8x8x4 latents; epsilon or v_prediction."""
    options = {"cross_attention_dim": sizes.text_width, "use_linear_projection": True}
    plain_unet(sizes.unet | options, seed).save_pretrained(folder / "unet")
    vae(folder, sizes.vae, latent_channels=4)
    _rename(folder / "vae" / "diffusion_pytorch_model.safetensors", _published_vae)
    clip_text_encoder(folder, sizes.text_width)
    _stable_diffusion_scheduler(prediction).save_pretrained(folder / "scheduler")
    return write_index(folder, "StableDiffusionPipeline", **NO_CHECKER)


def vae(folder: Path, sizes: dict[str, Any] = TINY.vae, **options: Any) -> None:
    """Write ``vae``, 64 x 64 pixels to 8 x 8 latents by default."""
    from diffusers import AutoencoderKL

    options |= {"down_block_types": ("DownEncoderBlock2D",) * 4}
    options |= {"up_block_types": ("UpDecoderBlock2D",) * 4}
    AutoencoderKL(**sizes, **options).save_pretrained(folder / "vae")


def _stable_diffusion_scheduler(prediction: str) -> Any:
    """Make the published scheduler: PNDM for 2.1-base, DDIM for 2.1 (768, v-prediction)."""
    from diffusers import DDIMScheduler, PNDMScheduler

    trained = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
    trained |= {"steps_offset": 1, "set_alpha_to_one": False}
    if prediction == "epsilon":
        scheduler = PNDMScheduler(**trained, skip_prk_steps=True)
    else:
        scheduler = DDIMScheduler(**trained, clip_sample=False)
    scheduler.register_to_config(prediction_type=prediction)
    return scheduler


def deep_floyd(folder: Path, *, seed: int = 0) -> Path:
    """Write a tiny DeepFloyd IF, stage 1, on 16x16 pixels, with a T5 encoder."""
    from diffusers import DDPMScheduler

    options = dict(
        sample_size=16, in_channels=3, out_channels=6, block_out_channels=(16, 32),
        layers_per_block=1, mid_block_type="UNetMidBlock2DSimpleCrossAttn",
        down_block_types=("ResnetDownsampleBlock2D", "SimpleCrossAttnDownBlock2D"),
        up_block_types=("SimpleCrossAttnUpBlock2D", "ResnetUpsampleBlock2D"),
        cross_attention_dim=64, encoder_hid_dim=TEXT_WIDTH, attention_head_dim=8,
        addition_embed_type="text", addition_embed_type_num_heads=2,
        cross_attention_norm="group_norm", resnet_time_scale_shift="scale_shift",
        norm_num_groups=8, act_fn="gelu",
    )  # fmt: skip
    plain_unet(options, seed).save_pretrained(folder / "unet")
    t5_text_encoder(folder)
    options = {"beta_schedule": "squaredcos_cap_v2", "prediction_type": "epsilon"}
    options |= {"variance_type": "learned_range", "thresholding": True, "sample_max_value": 1.5}
    DDPMScheduler(**options).save_pretrained(folder / "scheduler")
    return write_index(folder, "IFPipeline", watermarker=[None, None], **NO_CHECKER)


def listen_to_text(unet: torch.nn.Module) -> None:
    """Scale up the cross-attention: with initial weights two prompts are nearly equal."""
    for name, weight in unet.named_parameters():
        if name.endswith(("attn2.to_v.weight", "add_v_proj.weight")):
            weight.data *= 10


def clip_text_encoder(folder: Path, width: int = TEXT_WIDTH, *, suffix="", projection=0) -> None:
    """Write ``text_encoder`` and ``tokenizer``, with a suffix: CLIP, padded with "!", which one of
    its two files contradicts; ``projection`` is the width of the pooled embedding, 0 for none.
    """
    from transformers import CLIPTextModel, CLIPTextModelWithProjection

    config = clip_text_config(width, projection or 512, hidden_act="gelu", pad_token_id=0)
    encoder = (CLIPTextModelWithProjection if projection else CLIPTextModel)(config)
    encoder.save_pretrained(folder / f"text_encoder{suffix}")
    positions = {"text_model.embeddings.position_ids": torch.arange(77)[None]}  # earlier versions'
    _rename(folder / f"text_encoder{suffix}" / "model.safetensors", _published_clip, **positions)
    special = clip_tokenizer(folder / f"tokenizer{suffix}")
    path = folder / f"tokenizer{suffix}" / "special_tokens_map.json"
    write_json(path, special | {"pad_token": "!"})


def clip_text_config(width: int, projection: int, **options: Any) -> Any:
    from transformers import CLIPTextConfig

    vocabulary = _byte_vocabulary()
    options |= {"bos_token_id": vocabulary["<|startoftext|>"], "projection_dim": projection}
    options |= {"eos_token_id": vocabulary["<|endoftext|>"], "vocab_size": len(vocabulary)}
    options |= {"hidden_size": width, "intermediate_size": 48}
    return CLIPTextConfig(num_hidden_layers=2, num_attention_heads=2, **options)


def clip_tokenizer(folder: Path) -> dict[str, str]:
    """Write CLIP's tokenizer; return its special tokens but for the padding."""
    folder.mkdir(parents=True, exist_ok=True)
    write_json(folder / "vocab.json", _byte_vocabulary())
    (folder / "merges.txt").write_text("#version: 0.2\nf o\nfo x</w>\n", encoding="utf-8")
    end = "<|endoftext|>"
    special = {"bos_token": "<|startoftext|>", "eos_token": end, "unk_token": end}
    options = {"pad_token": end, "model_max_length": 77, "do_lower_case": True}
    options |= {"tokenizer_class": "CLIPTokenizer"}
    write_json(folder / "tokenizer_config.json", special | options)
    return special


def t5_text_encoder(folder: Path, width: int = TEXT_WIDTH, *, suffix: str = "") -> None:
    """Write ``text_encoder`` and ``tokenizer``, with a suffix: T5 v1.1 and sentencepiece."""
    from transformers import T5Config, T5EncoderModel

    tokenizer = folder / f"tokenizer{suffix}"
    tokenizer.mkdir(parents=True)
    (tokenizer / "spiece.model").write_bytes(_sentencepiece())
    special = {"eos_token": "</s>", "unk_token": "<unk>", "pad_token": "<pad>"}
    special |= {"tokenizer_class": "T5Tokenizer", "model_max_length": 512, "extra_ids": 100}
    write_json(tokenizer / "tokenizer_config.json", special)
    sizes = {"d_model": width, "d_kv": 8, "d_ff": 48, "num_layers": 2, "num_heads": 4}
    sizes |= {"vocab_size": 200, "feed_forward_proj": "gated-gelu"}
    config = T5Config(**sizes, tie_word_embeddings=False)
    T5EncoderModel(config).save_pretrained(folder / f"text_encoder{suffix}")


def _published_clip(name: str) -> str:
    return "text_model." * (not name.startswith(("text_model.", "text_projection."))) + name


def _published_vae(name: str) -> str:
    for new, old in PUBLISHED_VAE_NAMES.items():
        name = name.replace(new, old)
    return name


def _rename(path: Path, published: Callable[[str], str], **added: torch.Tensor) -> None:
    from safetensors.torch import load_file, save_file

    tensors = {published(name): tensor for name, tensor in load_file(path).items()}
    save_file(tensors | added, path, metadata={"format": "pt"})


def _byte_vocabulary() -> dict[str, int]:
    """Return CLIP's byte-level vocabulary with two merges."""
    printable = [i for a, b in ("!~", "¡¬", "®ÿ") for i in range(ord(a), ord(b) + 1)]
    letters = [*map(chr, printable), *(chr(256 + i) for i in range(256 - len(printable)))]
    tokens = [*letters, *(letter + "</w>" for letter in letters)]
    tokens += ["fo", "fox</w>", "<|startoftext|>", "<|endoftext|>"]
    return {token: index for index, token in enumerate(tokens)}


def _sentencepiece() -> bytes:
    import sentencepiece

    model = BytesIO()
    sentencepiece.SentencePieceTrainer.train(
        sentence_iterator=iter([CORPUS] * 20), model_writer=model, vocab_size=60,
        hard_vocab_limit=False, pad_id=0, eos_id=1, unk_id=2, bos_id=-1, minloglevel=2,
    )  # fmt: skip
    return model.getvalue()


NO_CHECKER = dict.fromkeys(("safety_checker", "feature_extractor"), [None, None])
NO_CHECKER |= {"requires_safety_checker": False}


def write_index(folder: Path, pipeline: str, **options: Any) -> Path:
    """Write ``model_index.json``, with the class of each component that was saved."""
    index = {"_class_name": pipeline, "_diffusers_version": "0.8.0", **options}
    for path in folder.glob("*/*config.json"):
        config, name = json.loads(path.read_text(encoding="utf-8")), path.parent.name
        library = "transformers" if name.startswith(("text_encoder", "tokenizer")) else "diffusers"
        kind = config.get("_class_name") or config.get("tokenizer_class")
        index[name] = [library, kind or config["architectures"][0]]
    write_json(folder / "model_index.json", index)
    return folder


def write_json(path: Path, content: dict) -> None:
    path.write_text(json.dumps(content, ensure_ascii=False), encoding="utf-8")


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
    from diffusers import EulerDiscreteScheduler

    options = {"cross_attention_dim": sum(CLIP_WIDTHS), "use_linear_projection": True}
    options |= {"addition_embed_type": "text_time", "addition_time_embed_dim": 8}
    options |= {"projection_class_embeddings_input_dim": 6 * 8 + POOLED}
    plain_unet(TINY.unet | options, seed).save_pretrained(folder / "unet")
    vae(folder, latent_channels=4, scaling_factor=0.13025, force_upcast=force_upcast)
    clip_text_encoder(folder, CLIP_WIDTHS[0])
    clip_text_encoder(folder, CLIP_WIDTHS[1], suffix="_2", projection=POOLED)
    betas = {"beta_start": 0.00085, "beta_end": 0.012, "beta_schedule": "scaled_linear"}
    EulerDiscreteScheduler(**betas, steps_offset=1).save_pretrained(folder / "scheduler")
    return write_index(folder, "StableDiffusionXLPipeline", force_zeros_for_empty_prompt=True)


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
    return write_index(folder, "StableDiffusion3Pipeline")


def mvdream(folder: Path, *, seed: int = 0, **settings: Any) -> Path:
    """Write a tiny MVDream as it was converted, with the code of its UNet, which must not run."""
    from safetensors.torch import save_file

    from threestudio_gaussiandreamer.models.multiview_unet import unet_options

    stable_diffusion(folder, seed=seed)
    state = plain_unet(unet_options(MULTI_VIEW), seed).state_dict()
    for file in (folder / "unet").iterdir():
        file.unlink()
    tensors = {compvis_name(name, MULTI_VIEW): value for name, value in state.items()}
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
    made = UNet2DConditionModel(**options)
    listen_to_text(made)
    return made.eval()


RESNET = {
    "norm1": "in_layers.0", "conv1": "in_layers.2", "time_emb_proj": "emb_layers.1",
    "norm2": "out_layers.0", "conv2": "out_layers.3", "conv_shortcut": "skip_connection",
}  # fmt: skip
OUTER = {
    "time_embedding.linear_1": "time_embed.0", "time_embedding.linear_2": "time_embed.2",
    "class_embedding.linear_1": "camera_embed.0", "class_embedding.linear_2": "camera_embed.2",
    "conv_in": "input_blocks.0.0", "conv_norm_out": "out.0", "conv_out": "out.2",
}  # fmt: skip


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
