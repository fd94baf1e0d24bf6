"""Point-E's two networks, which turn noisy points into clean ones, under the names of the published
checkpoints.

Written from the architecture that the checkpoints fix (Nichol et al. 2022, "Point-E"; published by
OpenAI under MIT): a plain transformer without positions, so a set of points in any order. The base
model gets two tokens more, the text's features and the timestep; the upsampler one for the
timestep, one for each of 256 cells of an image, which text-to-3D leaves empty, and one for each
coarse point. All sizes are read off the weights; a head has 64 channels in every published model.
"""

import math
from typing import Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float, Real
from torch import Tensor, nn

HEAD_CHANNELS = 64
IMAGE_CELLS = 256
"""16 x 16 patches of the ViT-L/14 that the upsampler was trained with."""
CHANNELS = 6
"""x, y, z, red, green, blue of a point; the networks give these and as many for the variance."""


class Mlp(nn.Module):
    def __init__(self, width: int) -> None:
        super().__init__()
        self.c_fc = nn.Linear(width, 4 * width)
        self.c_proj = nn.Linear(4 * width, width)

    def forward(self, x: Tensor) -> Tensor:
        return self.c_proj(F.gelu(self.c_fc(x)))


class Attention(nn.Module):
    """Self-attention whose packed projection is ordered head by head: query, key and value of the
    first head come first.
    """

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


class Backbone(nn.Module):
    def __init__(self, width: int, layers: int, heads: int) -> None:
        super().__init__()
        self.resblocks = nn.ModuleList(Block(width, heads) for _ in range(layers))

    def forward(self, x: Tensor) -> Tensor:
        for block in self.resblocks:
            x = block(x)
        return x


class PointTransformer(nn.Module):
    """What both networks have: points and extra tokens through one transformer, and the points'
    part of the result.
    """

    def __init__(self, width: int, layers: int, heads: Optional[int] = None) -> None:
        super().__init__()
        self.width = width
        self.time_embed = Mlp(width)
        self.ln_pre = nn.LayerNorm(width)
        self.backbone = Backbone(width, layers, heads or width // HEAD_CHANNELS)
        self.ln_post = nn.LayerNorm(width)
        self.input_proj = nn.Linear(CHANNELS, width)
        self.output_proj = nn.Linear(width, 2 * CHANNELS)

    def time_token(self, timesteps: Real[Tensor, " B"]) -> Float[Tensor, "B 1 W"]:
        return self.time_embed(timestep_embedding(timesteps, self.width))[:, None]

    def transform(
        self, points: Float[Tensor, "B 6 N"], tokens: list[Tensor]
    ) -> Float[Tensor, "B 12 N"]:
        h = torch.cat([*tokens, self.input_proj(points.transpose(1, 2))], dim=1)
        h = self.ln_post(self.backbone(self.ln_pre(h)))
        return self.output_proj(h[:, -points.shape[-1] :]).transpose(1, 2)


class BaseModel(PointTransformer):
    """From noise to coarse points, given the text's features (``base40M-textvec``)."""

    def __init__(
        self, width: int = 512, layers: int = 12, features: int = 768, heads: Optional[int] = None
    ) -> None:
        super().__init__(width, layers, heads)
        self.clip_embed = nn.Linear(features, width)

    def forward(
        self, points: Float[Tensor, "B 6 N"], timesteps: Tensor, condition: Float[Tensor, "B D"]
    ) -> Float[Tensor, "B 12 N"]:
        tokens = [self.clip_embed(condition)[:, None], self.time_token(timesteps)]
        return self.transform(points, tokens)


class Upsampler(PointTransformer):
    """From noise to further points, given the coarse ones (``upsample``)."""

    def __init__(
        self, width: int = 512, layers: int = 12, features: int = 1024, heads: Optional[int] = None
    ) -> None:
        super().__init__(width, layers, heads)
        self.cond_point_proj = nn.Linear(CHANNELS, width)
        self.clip_embed = nn.Sequential(nn.LayerNorm(features), nn.Linear(features, width))
        self.register_buffer("channel_scales", torch.tensor([2.0] * 3 + [2 / 255] * 3))
        self.register_buffer("channel_biases", torch.tensor([0.0] * 3 + [-1.0] * 3))

    def forward(
        self, points: Float[Tensor, "B 6 N"], timesteps: Tensor, coarse: Float[Tensor, "B 6 M"]
    ) -> Float[Tensor, "B 12 N"]:
        """Take ``coarse`` in the points' own units: positions, and colours up to 255."""
        features = self.clip_embed[0].normalized_shape[0]
        no_image = self.clip_embed(points.new_zeros(len(points), 1, features))
        scaled = coarse * self.channel_scales[:, None] + self.channel_biases[:, None]
        tokens = [
            self.time_token(timesteps),
            no_image.expand(-1, IMAGE_CELLS, -1),
            self.cond_point_proj(scaled.transpose(1, 2)),
        ]
        return self.transform(points, tokens)


def timestep_embedding(timesteps: Real[Tensor, " B"], width: int) -> Float[Tensor, "B W"]:
    """Return cosines, then sines, of frequencies that fall from 1 to 1/10000 (Vaswani et
    al. 2017).
    """
    steps = torch.arange(width // 2, device=timesteps.device)
    frequencies = torch.exp(-math.log(10000) * steps / (width // 2))
    angles = timesteps.float()[:, None] * frequencies
    return torch.cat([angles.cos(), angles.sin()], dim=-1)


def sizes_of(state: dict[str, Tensor]) -> dict[str, int]:
    """Return ``width`` and ``layers`` of the model whose weights these are; zeros where they are
    none of Point-E's.
    """
    blocks = {name.split(".")[2] for name in state if name.startswith("backbone.resblocks.")}
    norm = state.get("ln_pre.weight")
    return {"width": 0 if norm is None else len(norm), "layers": len(blocks)}
