"""Half-precision networks with float32 inputs and outputs: their dtype, and a scaling of gradients
that prevents overflow and underflow in the backward pass.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import FunctionCtx

PEAK = 64.0
"""Gradients are scaled so that their largest element is in [PEAK, 2 PEAK) when they enter the
backward pass of a half-precision network.

float16 represents magnitudes from 6e-8 to 65504. Inside the network gradients may thus grow by a
factor of 500, and elements 10^9 times smaller than the largest don't vanish.
"""


HALF_TYPES = {"float16": torch.float16, "bfloat16": torch.bfloat16}


def weights_type(half: bool, device: torch.device, half_type: str = "float16") -> torch.dtype:
    """Return the type named ``half_type`` on a GPU if ``half`` is set, else float32. On the CPU
    half precision has no advantage.
    """
    return HALF_TYPES[half_type] if half and device.type == "cuda" else torch.float32


class PerItemLossScale:
    """A separate loss scale for each item, for one forward and backward pass of a half-precision
    network.

    ``enter`` is applied to the input of the network and ``leave`` to its output; both are the
    identity in the forward pass. In the backward pass ``leave`` multiplies the gradient of each
    item by a power of two, and ``enter`` divides by it in float32. The loss may thus have any
    scale, also a gradient scaler's 65536.

    Args:
        on_result: called in the backward pass with a mask, (B,) bool, of items whose gradient isn't
            finite; those gradients are set to zero.
    """

    def __init__(self, on_result: Callable[[Bool[Tensor, " B"]], None]) -> None:
        self.on_result = on_result
        self.scale: Tensor = torch.ones(())

    def enter(self, x: Float[Tensor, "B *d"]) -> Float[Tensor, "B *d"]:
        return _Enter.apply(x, self)

    def leave(self, y: Float[Tensor, "B *e"]) -> Float[Tensor, "B *e"]:
        return _Leave.apply(y, self)


class _Leave(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, y: Tensor, loss_scale: PerItemLossScale) -> Tensor:
        ctx.loss_scale = loss_scale
        return y.view_as(y)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        peak = grad.abs().amax(dim=tuple(range(1, grad.dim())), keepdim=True)
        ctx.loss_scale.scale = torch.where(peak > 0, PEAK / torch.exp2(peak.log2().floor()), 1.0)
        return grad * ctx.loss_scale.scale, None


class _Enter(torch.autograd.Function):
    @staticmethod
    def forward(ctx: FunctionCtx, x: Tensor, loss_scale: PerItemLossScale) -> Tensor:
        ctx.loss_scale = loss_scale
        return x.view_as(x)

    @staticmethod
    def backward(ctx: FunctionCtx, grad: Tensor) -> tuple[Tensor, None]:
        bad = ~torch.isfinite(grad).flatten(1).all(dim=1)
        ctx.loss_scale.on_result(bad)
        per_item = (-1, *[1] * (grad.dim() - 1))
        return torch.where(bad.reshape(per_item), 0.0, grad) / ctx.loss_scale.scale.reshape(
            per_item
        ), None
