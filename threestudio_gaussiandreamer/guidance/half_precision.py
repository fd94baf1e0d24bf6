"""Half-precision networks between float32 tensors: their type, and gradients that neither overflow
nor vanish on the way back.
"""

from collections.abc import Callable

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.autograd.function import FunctionCtx

PEAK = 64.0
"""A gradient enters a half-precision network with a largest element in [PEAK, 2 PEAK): float16 goes
up to 65504, and down to 6e-8, so that it may grow a thousandfold inside and elements a hundred
million times smaller still count.
"""


def weights_type(half: bool, device: torch.device) -> torch.dtype:
    """Return float16 on a GPU when ``half`` is asked for, else float32: the CPU gains nothing from
    half precision.
    """
    return torch.float16 if half and device.type == "cuda" else torch.float32


class PerItemLossScale:
    """Loss scale of each item inside a half-precision network, for one forward and backward pass.

    ``leave`` scales each item's gradient by a power of two before it goes back through the network,
    ``enter`` undoes that in float32 behind it. Both are the identity forwards. The loss may thus
    have any scale, a gradient scaler's 65536 included.

    Args:
        on_result: told, when the gradient has come back, which items' isn't finite, (B,) bool;
            those are set to zero.
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
