"""A guidance that reuses the features of a U-Net's inner blocks for near views and timesteps, as
Hash3D does (Yang and Wang 2024, arXiv:2404.06091). It isn't part of the package, since it brings
less than fewer steps; docs/distillation.md has its figures.

    python -m benchmarks.quality.toybox --charts default feature_reuse --count 10 --seeds 0 1

The output of the blocks between the first and the last is kept by cells of azimuth, elevation,
timestep and prompt. A view in a known cell is given what was kept last, and needs the first and the
last block only; one of ten such views is predicted as a whole, which replaces what is kept. Hash3D
averages the kept features of a cell in place of that.

=================================================  =================================================
option                                             meaning
=================================================  =================================================
azimuth_cell, elevation_cell                       width of the cells, degrees
timestep_cell                                      width of the cells, timesteps
=================================================  =================================================
"""

from collections.abc import Hashable
from dataclasses import dataclass
from typing import Any, Optional

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.utils.flop_counter import FlopCounterMode

from threestudio_gaussiandreamer.guidance.score_pictures import Noised
from threestudio_gaussiandreamer.guidance.stable_diffusion import StableDiffusionGuidance
from threestudio_gaussiandreamer.guidance.text_condition import (
    Condition,
    Embeddings,
    Latents,
    Timesteps,
)
from threestudio_gaussiandreamer.host import register, run_seed

REUSED = 0.9
"""Share of the views in known cells that aren't predicted as a whole."""


@register("feature-reuse-guidance")
class FeatureReuseGuidance(StableDiffusionGuidance):
    """Score distillation with a U-Net of which the inner blocks' features are reused."""

    @dataclass
    class Config(StableDiffusionGuidance.Config):
        azimuth_cell: float = 45.0
        elevation_cell: float = 35.0
        timestep_cell: int = 100

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self._features: dict[Hashable, Float[Tensor, "c h w"]] = {}
        self._rng = torch.Generator().manual_seed(run_seed())
        self._inner_share: Optional[float] = None

    def condition(self, prompt_utils: Any, **batch: Any) -> Condition:
        azimuth = (batch["azimuth"] / self.cfg.azimuth_cell).floor().tolist()
        elevation = (batch["elevation"] / self.cfg.elevation_cell).floor().tolist()
        self._cells = list(zip(azimuth, elevation, strict=True))
        return super().condition(prompt_utils, **batch)

    def noised(self, latents: Latents, noise: Latents) -> Noised:
        found = super().noised(latents, noise)
        self._z = found.z
        return found

    def run_network(
        self, z: Latents, t: Timesteps, embeddings: Embeddings, **inputs: Tensor
    ) -> Latents:
        keys = [self._key(*row) for row in zip(z, t, embeddings, strict=True)]
        chance = torch.rand(len(keys), generator=self._rng)
        known = torch.tensor([key in self._features for key in keys])
        reused = known & (chance < REUSED)
        arguments = z.to(self.dtype), t, embeddings.to(self.dtype)
        if self._inner_share is None:
            self._inner_share = inner_share(self.unet, *arguments)
        self.evaluations -= self._inner_share * int(reused.sum())
        output = torch.empty_like(arguments[0])
        for rows, kept in ((reused.nonzero()[:, 0], True), ((~reused).nonzero()[:, 0], False)):
            if not len(rows):
                continue
            own = [keys[row] for row in rows]
            features = torch.stack([self._features[key] for key in own]) if kept else None
            rows = rows.to(z.device)
            output[rows], features = predict(
                self.unet, *(value[rows] for value in arguments), features
            )
            self._features |= zip(own, features, strict=True)
        return output

    def _key(self, z: Tensor, t: Tensor, embedding: Tensor) -> Hashable:
        """Return the cell of one row of the network's inputs."""
        view = int((self._z == z).flatten(1).all(1).nonzero()[0, 0])
        prompt = float(embedding.double().sum())
        return (*self._cells[view], int(t) // self.cfg.timestep_cell, prompt)


class Blocks:
    """Runs the blocks of a U-Net that has no further inputs, and holds its skip connections."""

    def __init__(self, unet: nn.Module, z: Latents, t: Timesteps, tokens: Embeddings):
        self.embedded = unet.time_embedding(unet.get_time_embed(sample=z, timestep=t))
        self.tokens, self.skips = tokens, []

    def run(self, block: nn.Module, hidden: Tensor, **options: Any) -> Any:
        if getattr(block, "has_cross_attention", False):
            options["encoder_hidden_states"] = self.tokens
        return block(hidden_states=hidden, temb=self.embedded, **options)

    def down(self, block: nn.Module, hidden: Tensor) -> Tensor:
        hidden, outputs = self.run(block, hidden)
        self.skips += outputs
        return hidden

    def up(self, block: nn.Module, hidden: Tensor) -> Tensor:
        skipped = tuple(self.skips.pop() for _ in block.resnets)[::-1]
        return self.run(block, hidden, res_hidden_states_tuple=skipped)


def predict(
    unet: nn.Module,
    z: Latents,
    t: Timesteps,
    tokens: Embeddings,
    features: Optional[Float[Tensor, "B c h w"]] = None,
) -> tuple[Latents, Float[Tensor, "B c h w"]]:
    """Predict the noise.

    Args:
        features: of the inner blocks, which aren't run then.

    Returns:
        the output, and the features of the inner blocks.
    """
    first, *inner_down = unet.down_blocks
    *inner_up, last = unet.up_blocks
    blocks, hidden = Blocks(unet, z, t, tokens), unet.conv_in(z)
    blocks.skips = [hidden]
    hidden = blocks.down(first, hidden)
    if features is None:
        for block in inner_down:
            hidden = blocks.down(block, hidden)
        if unet.mid_block is not None:
            hidden = blocks.run(unet.mid_block, hidden)
        for block in inner_up:
            hidden = blocks.up(block, hidden)
        features = hidden
    del blocks.skips[len(last.resnets) :]
    output = blocks.up(last, features)
    return unet.conv_out(unet.conv_act(unet.conv_norm_out(output))), features


def inner_share(unet: nn.Module, z: Latents, t: Timesteps, tokens: Embeddings) -> float:
    """Return the inner blocks' share of the U-Net's operations."""
    with FlopCounterMode(display=False) as whole:
        _, features = predict(unet, z, t, tokens)
    with FlopCounterMode(display=False) as outer:
        predict(unet, z, t, tokens, features)
    return 1 - outer.get_total_flops() / whole.get_total_flops()
