"""``point-e-prior``: 4096 coloured points by OpenAI's Point-E, the paper's second text-to-3D model.

==================  ================================================================================
option              meaning
==================  ================================================================================
checkpoint          ``base_40m_textvec.pt`` as OpenAI publishes it, or Cap3D's
                    ``pointE_finetuned_with_330kdata.pth``; or ``toybox``, the bundled one
upsampler           ``upsample_40m.pt``; null: only the coarse points, without upsampling
clip                OpenAI's CLIP ViT-L/14 in transformers' format, a folder or an id of the hub; or
                    ``toybox``
num_points          number of coarse points; 1024
num_steps           noise levels of each stage; 64
prompt, ...         see ``priors/karras.py``; the upsampler isn't guided
ground, ...         see ``priors/base.py``
==================  ================================================================================

The user downloads the files (``docs/models.md``). On a CPU sampling takes minutes. The axes are
those of Shap-E: z up and front -y, which becomes +x.

The networks, which diffusers lacks, are written from the architecture that the checkpoints fix
(Nichol et al. 2022, "Point-E"; published by OpenAI under MIT): a transformer without positions, so
a set of points in any order. The base model gets two tokens more, the text's features and the
timestep; the upsampler one for the timestep, one for each of 256 cells of an image, here empty, and
one for each coarse point. All sizes but that of a head are read off the weights."""

import math
from dataclasses import dataclass, field
from typing import Any, ClassVar, Optional

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Float, Real
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.extras import require_extra
from ..core.files import existing_file
from ..core.options import in_range, required
from ..gaussians.point_cloud import PointCloud
from ..host import info, register
from ..models.bundled import NAME as BUNDLED
from ..models.bundled import POINTS, model_part
from ..models.clip import clip_source
from ..models.hub import locate
from ..models.model_files import free_memory, load_exactly, loaded, read_state_dict
from . import karras
from .base import points
from .karras import SampledPrior

UPSAMPLED = 3072
"""Number of points that the upsampler adds."""
HEAD_CHANNELS = 64
CHANNELS = 6
"""x, y, z, red, green, blue of a point; the networks give these and as many for the variance."""
SCALES = torch.tensor([2.0] * 3 + [2 / 255] * 3)[:, None]
BIASES = torch.tensor([0.0] * 3 + [-1.0] * 3)[:, None]
"""Inputs are ``points * SCALES + BIASES``, of positions in [-0.5, 0.5] and colours up to 255."""
CHECKPOINT = required(
    "Point-E's weights are a file that you download; set checkpoint to base_40m_textvec.pt"
)


@register("point-e-prior")
class PointEPrior(SampledPrior):
    """Sample points for the prompt with Point-E."""

    @dataclass
    class Config(SampledPrior.Config):
        checkpoint: str = field(default="", metadata=CHECKPOINT)
        upsampler: Optional[str] = None
        clip: str = "openai/clip-vit-large-patch14"
        num_points: int = field(default=1024, metadata=points(1))
        num_steps: int = field(default=64, metadata=in_range(1, 10_000))
        REMOVED: ClassVar[dict[str, Any]] = {
            **SampledPrior.Config.REMOVED,
            "num_upsampled": (UPSAMPLED, f"it is {UPSAMPLED}"),
            "sigma_max": ([120.0, 160.0], "they are 120 and 160"),
            "churn": ([3.0, 0.0], "it is 3 and 0"),
        }

    cfg: Config

    def preflight(self) -> None:
        existing_file(model_part(self.cfg.checkpoint, POINTS), BaseModel.title, (BUNDLED,))
        if self.cfg.upsampler:
            existing_file(self.cfg.upsampler, Upsampler.title)
        require_extra("diffusion", "transformers")
        locate(clip_source(self.cfg.clip), download=False)

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        self.preflight()
        cfg, rng = self.cfg, karras.torch_generator(generator)
        info(f"Point-E: {cfg.prompt or prompt!r} on {self.device}")
        condition = self.condition("Point-E", locate(clip_source(cfg.clip)), prompt)
        network = self._network(BaseModel, model_part(cfg.checkpoint, POINTS))
        given, expected = condition.shape[-1], network.clip_embed.in_features
        if given != expected:
            raise UserError(
                f"clip: {cfg.clip!r} has {given} features, but the checkpoint was trained "
                f"with {expected}: use ViT-L/14"
            )
        predict, levels = mean_of(network, condition), karras.cosine_alphas_cumprod()
        denoise = karras.guided_denoiser(predict, levels, scale=cfg.guidance_scale)
        points = self._sampled(denoise, BaseModel, cfg.num_points, rng)
        if cfg.upsampler:
            predict = mean_of(self._network(Upsampler, cfg.upsampler), points)
            denoise = karras.guided_denoiser(predict, karras.linear_alphas_cumprod())
            points = torch.cat([points, self._sampled(denoise, Upsampler, UPSAMPLED, rng)], dim=-1)
        free_memory()
        rows = points[0].T.cpu().numpy()
        colors = rows[:, 3:].clip(0, 255).round() / np.float32(255)
        return self.placed(PointCloud(points=rows[:, :3], colors=colors))

    def _network(self, kind: type["PointTransformer"], path: str) -> Any:
        key = (kind.title, path, self.device)
        return loaded(key, lambda: load_network(kind, path).to(self.device))

    def _sampled(self, denoise: Any, kind: Any, count: int, rng: torch.Generator) -> Tensor:
        """Return points (1, 6, count) in Point-E's units: positions, and colours in [0, 255]."""
        noise = torch.randn(1, CHANNELS, count, generator=rng).to(self.device)
        sigmas = karras.karras_sigmas(self.cfg.num_steps, kind.sigma_max)
        options = {"churn": kind.churn, "generator": rng, "progress": kind.title}
        sample = karras.sample_heun(denoise, noise, sigmas, **options)
        return (sample - BIASES.to(self.device)) / SCALES.to(self.device)


def mean_of(network: nn.Module, condition: Tensor) -> karras.Network:
    """Return a network under a condition, without the variance in its second half of channels."""
    return lambda z, timesteps: network(z, timesteps, condition)[:, :CHANNELS]


# The networks, under the names of the published checkpoints ---------------------------------------


class Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.c_fc = nn.Linear(width, 4 * width)
        self.c_proj = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.c_proj(F.gelu(self.c_fc(x)))


class Attention(nn.Module):
    """Self-attention whose packed projection has query, key and value of each head together."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.c_qkv = nn.Linear(width, 3 * width)
        self.c_proj = nn.Linear(width, width)

    def forward(self, x: Float[Tensor, "B N W"]) -> Float[Tensor, "B N W"]:
        packed = self.c_qkv(x).unflatten(-1, (self.heads, 3, -1)).permute(3, 0, 2, 1, 4)
        attended = F.scaled_dot_product_attention(*packed)
        return self.c_proj(attended.transpose(1, 2).flatten(2))


class Block(nn.Module):
    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.attn = Attention(width, heads)
        self.ln_1 = nn.LayerNorm(width)
        self.mlp = Mlp(width)
        self.ln_2 = nn.LayerNorm(width)

    def forward(self, x: Tensor) -> Tensor:
        x = x + self.attn(self.ln_1(x))
        return x + self.mlp(self.ln_2(x))


class PointTransformer(nn.Module):
    """Points and extra tokens through one transformer, and the points' part of the result."""

    title: ClassVar[str]
    file: ClassVar[str]
    """The published one."""
    projection: ClassVar[str]
    """Name of a weight that only this network has, with as many columns as features of CLIP."""
    sigma_max: ClassVar[float]
    """The highest noise level."""
    churn: ClassVar[float]
    """S_churn of Karras et al."""

    def __init__(self, width: int, layers: int) -> None:
        super().__init__()
        self.width = width
        self.time_embed = Mlp(width)
        self.ln_pre = nn.LayerNorm(width)
        blocks = nn.Sequential(*(Block(width, width // HEAD_CHANNELS) for _ in range(layers)))
        self.backbone = nn.ModuleDict({"resblocks": blocks})
        self.ln_post = nn.LayerNorm(width)
        self.input_proj = nn.Linear(CHANNELS, width)
        self.output_proj = nn.Linear(width, 2 * CHANNELS)

    def time_token(self, timesteps: Real[Tensor, " B"]) -> Float[Tensor, "B 1 W"]:
        """Embed cosines, then sines, of frequencies from 1 to 1/10000 (Vaswani et al. 2017)."""
        steps = torch.arange(self.width // 2, device=timesteps.device)
        frequencies = torch.exp(-math.log(10000) * steps / (self.width // 2))
        angles = timesteps.float()[:, None] * frequencies
        return self.time_embed(torch.cat([angles.cos(), angles.sin()], dim=-1))[:, None]

    def transform(
        self, points: Float[Tensor, "B 6 N"], tokens: list[Tensor]
    ) -> Float[Tensor, "B 12 N"]:
        h = torch.cat([*tokens, self.input_proj(points.transpose(1, 2))], dim=1)
        h = self.ln_post(self.backbone.resblocks(self.ln_pre(h)))
        return self.output_proj(h[:, -points.shape[-1] :]).transpose(1, 2)


class BaseModel(PointTransformer):
    """From noise to coarse points, given the text's features (``base40M-textvec``)."""

    title, file = "Point-E base checkpoint", "base_40m_textvec.pt"
    projection, sigma_max, churn = "clip_embed.weight", 120.0, 3.0

    def __init__(self, width: int = 512, layers: int = 12, features: int = 768) -> None:
        super().__init__(width, layers)
        self.clip_embed = nn.Linear(features, width)

    def forward(
        self, points: Float[Tensor, "B 6 N"], timesteps: Tensor, condition: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B 12 N"]:
        tokens = [self.clip_embed(condition)[:, None], self.time_token(timesteps)]
        return self.transform(points, tokens)


class Upsampler(PointTransformer):
    """From noise to further points, given the coarse ones (``upsample``)."""

    title, file = "Point-E upsampler checkpoint", "upsample_40m.pt"
    projection, sigma_max, churn = "clip_embed.1.weight", 160.0, 0.0

    def __init__(self, width: int = 512, layers: int = 12, features: int = 1024) -> None:
        super().__init__(width, layers)
        self.cond_point_proj = nn.Linear(CHANNELS, width)
        self.clip_embed = nn.Sequential(nn.LayerNorm(features), nn.Linear(features, width))
        self.register_buffer("channel_scales", SCALES[:, 0].clone())
        self.register_buffer("channel_biases", BIASES[:, 0].clone())

    def forward(
        self, points: Float[Tensor, "B 6 N"], timesteps: Tensor, coarse: Float[Tensor, "B 6 M"]
    ) -> Float[Tensor, "B 12 N"]:
        """Take ``coarse`` in the points' own units: positions, and colours up to 255."""
        features = self.clip_embed[0].normalized_shape[0]
        no_image = self.clip_embed(points.new_zeros(len(points), 1, features))
        scaled = coarse * self.channel_scales[:, None] + self.channel_biases[:, None]
        tokens = [
            self.time_token(timesteps),
            no_image.expand(-1, 256, -1),  # 16 x 16 patches of ViT-L/14
            self.cond_point_proj(scaled.transpose(1, 2)),
        ]
        return self.transform(points, tokens)


# Loading ------------------------------------------------------------------------------------------


def load_network(kind: type[PointTransformer], path: str) -> Any:
    """Load a frozen network of the weights' sizes; raise UserError if unreadable or another."""
    state = read_state_dict(path, kind.title)
    layers = len({name.split(".")[2] for name in state if name.startswith("backbone.resblocks.")})
    width, projection = len(state.get("ln_pre.weight", ())), state.get(kind.projection)
    if projection is None or not layers or not width or width % HEAD_CHANNELS:
        raise UserError(
            f"{kind.title} {path!r} holds another model: give {kind.file} or a finetuned one "
            "of its format"
        )
    network = kind(width, layers, projection.shape[1])
    load_exactly(network, state, f"{kind.title} {path!r}")
    return network.eval().requires_grad_(False)
