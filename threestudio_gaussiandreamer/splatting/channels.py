"""Split colours into groups of three channels, which is what the compiled kernels blend."""

from typing import Optional

import torch
from torch import Tensor

from .scene import Scene

CHANNELS = 3


def groups(scene: Scene) -> list[Scene]:
    """Split a scene into scenes of at most three channels.

    A Gaussian with a channel that isn't finite becomes NaN in every group, so that all groups drop
    it.
    """
    if scene.channels <= CHANNELS:
        return [scene]
    colors = torch.where(scene.colors.isfinite().all(-1, keepdim=True), scene.colors, torch.nan)
    parts = zip(colors.split(CHANNELS, -1), scene.background.split(CHANNELS, -1), strict=True)
    return [scene._replace(colors=color, background=background) for color, background in parts]


def widen(x: Tensor, channels: int = CHANNELS) -> Tensor:
    """Pad the channels with zeros and return a contiguous tensor."""
    x, missing = x.contiguous(), channels - x.shape[-1]  # pad may keep a non-contiguous layout
    return torch.nn.functional.pad(x, (0, missing)) if missing else x


def narrow(x: Optional[Tensor], channels: int) -> Optional[Tensor]:
    """Remove the channels that `widen` added."""
    return x if x is None or channels == CHANNELS else x[..., :channels]
