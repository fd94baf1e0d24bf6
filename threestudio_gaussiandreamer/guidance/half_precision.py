"""Half-precision networks with float32 inputs and outputs: their number type, and a scaling of
gradients that prevents overflow and underflow in the backward pass.
"""

from collections.abc import Callable
from typing import Any

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from .base import find_bad_items, without_bad_items

PEAK = 64.0
"""Gradients are scaled so that their largest element is in [PEAK, 2 PEAK) when they enter the
backward pass of a half-precision network.

float16 represents magnitudes from 6e-8 to 65504. Inside the network gradients may thus grow by a
factor of 500, and elements 10^9 times smaller than the largest don't vanish.
"""


HALF_TYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


def weights_type(cfg: Any, device: torch.device) -> torch.dtype:
    """Return the number type of a network's weights: on a GPU ``half_precision_type``; on a CPU
    bfloat16, if ``half_precision_on_cpu`` is set and the CPU multiplies it; else float32.

    Args:
        cfg: options of a guidance by a text-to-image model. Without ``half_precision_weights`` the
            type is float32.
    """
    if not cfg.half_precision_weights:
        return torch.float32
    if device.type == "cuda":
        return HALF_TYPES[cfg.half_precision_type]
    native = cfg.half_precision_on_cpu and cpu_multiplies_bfloat16()
    return torch.bfloat16 if native else torch.float32


def cpu_multiplies_bfloat16() -> bool:
    """Return whether the CPU has instructions that multiply bfloat16 (AVX-512 BF16, AMX). Others
    convert each number, which takes more time than float32.
    """
    has = getattr(torch.cpu, "get_capabilities", dict)()  # older torch doesn't report any
    return any(has.get(name, False) for name in ("avx512_bf16", "amx_bf16"))


class PerItemLossScale:
    """A separate loss scale for each item, for one forward and backward pass of a half-precision
    network, whose input is passed to ``enter`` and its output to ``leave``.

    In the backward pass the gradient of each item is multiplied by a power of two where it enters
    the network, and divided by it in float32 where it leaves. The loss may thus have any scale,
    also a gradient scaler's 65536.

    Args:
        on_result: called in the backward pass with a mask, (B,) bool, of items whose gradient isn't
            finite; those gradients are set to zero.
    """

    def __init__(self, on_result: Callable[[Bool[Tensor, " B"]], None]) -> None:
        self.on_result = on_result
        self.scale: Tensor = torch.ones(())

    def enter(self, x: Float[Tensor, "B *d"]) -> Float[Tensor, "B *d"]:
        if x.requires_grad:
            x.register_hook(self._unscaled)
        return x

    def leave(self, y: Float[Tensor, "B *e"]) -> Float[Tensor, "B *e"]:
        if y.requires_grad:
            y.register_hook(self._scaled)
        return y

    def _scaled(self, grad: Float[Tensor, "B *e"]) -> Float[Tensor, "B *e"]:
        peak = grad.abs().amax(dim=tuple(range(1, grad.dim())), keepdim=True)
        self.scale = torch.where(peak > 0, PEAK / torch.exp2(peak.log2().floor()), 1.0)
        return grad * self.scale

    def _unscaled(self, grad: Float[Tensor, "B *d"]) -> Float[Tensor, "B *d"]:
        bad = find_bad_items(grad)
        self.on_result(bad)
        scale = self.scale.reshape(-1, *[1] * (grad.dim() - 1))
        return without_bad_items(grad, bad) / scale
