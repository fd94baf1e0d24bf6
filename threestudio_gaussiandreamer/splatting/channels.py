"""Kernels blend three colour channels; other numbers of channels are drawn three at a time."""

from typing import Optional

import torch
from torch import Tensor

from .scene import Scene

CHANNELS = 3


def groups(scene: Scene) -> list[Scene]:
    """Split a scene by channels, up to three in each.

    A Gaussian with one colour that isn't finite is dropped, so every group has to show it.
    """
    if scene.channels <= CHANNELS:
        return [scene]
    colors = torch.where(scene.colors.isfinite().all(-1, keepdim=True), scene.colors, torch.nan)
    parts = zip(colors.split(CHANNELS, -1), scene.background.split(CHANNELS, -1), strict=True)
    return [scene._replace(colors=color, background=background) for color, background in parts]


def widen(x: Tensor, channels: int = CHANNELS) -> Tensor:
    """Make contiguous, with zeros for the channels that are missing."""
    x, missing = x.contiguous(), channels - x.shape[-1]  # padding keeps some other layouts
    return torch.nn.functional.pad(x, (0, missing)) if missing else x


def narrow(x: Optional[Tensor], channels: int) -> Optional[Tensor]:
    """Remove the channels that `widen` added."""
    return x if x is None or channels == CHANNELS else x[..., :channels]
