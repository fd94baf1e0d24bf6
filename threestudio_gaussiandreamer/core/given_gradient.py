"""A number whose gradient is given."""

from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor


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
    def backward(ctx: Any, upstream: Tensor) -> tuple[Tensor, None, None]:
        (gradient,) = ctx.saved_tensors
        return upstream * gradient, None, None
