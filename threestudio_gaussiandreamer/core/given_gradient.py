"""A number whose gradient is given."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor
from torch.autograd.function import once_differentiable


def given_gradient(
    x: Float[Tensor, "*d"], gradient: Float[Tensor, "*d"], value: Float[Tensor, ""]
) -> Float[Tensor, ""]:
    """Return the number ``value``, a constant, as a function of ``x`` with this gradient; torch's
    ``torch.autograd.backward(x, gradient)`` imports all of its symbolic shapes.
    """
    return _GivenGradient.apply(x, gradient, value)


class _GivenGradient(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, x: Tensor, gradient: Tensor, value: Tensor) -> Tensor:
        ctx.save_for_backward(gradient)
        return value.clone()

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        # saves a pass over the pixels; on a GPU, looking would wait for it
        is_one = upstream.device.type == "cpu" and upstream.item() == 1
        return gradient if is_one else upstream * gradient, None, None
