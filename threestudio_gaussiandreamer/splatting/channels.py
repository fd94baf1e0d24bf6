"""Kernels blend three colour channels; other numbers of channels are drawn three at a time."""

from typing import Optional

import torch
from torch import Tensor

CHANNELS = 3


def groups(colors: Tensor, background: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Colours (..., N, C) and backgrounds (B, C) split by channels, up to three in each.

    A Gaussian with one colour that isn't finite is dropped, so every group has to show it.
    """
    if colors.shape[-1] <= CHANNELS:
        return [(colors, background)]
    colors = torch.where(colors.isfinite().all(-1, keepdim=True), colors, torch.nan)
    return list(zip(colors.split(CHANNELS, -1), background.split(CHANNELS, -1), strict=True))


def widen(x: Tensor, channels: int = CHANNELS) -> Tensor:
    """Contiguous, with zeros for the channels that are missing."""
    x, missing = (
        x.contiguous(),
        channels - x.shape[-1],
    )  # before padding, which keeps some other layouts
    return torch.nn.functional.pad(x, (0, missing)) if missing else x


def narrow(x: Optional[Tensor], channels: int) -> Optional[Tensor]:
    """Without the channels that `widen` added."""
    return x if x is None or channels == CHANNELS else x[..., :channels]
