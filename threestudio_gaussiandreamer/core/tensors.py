"""A number whose gradient is given, and the rotation matrix of a quaternion."""

from typing import Any, TypeVar

import torch
from jaxtyping import Float
from torch import Tensor

T = TypeVar("T")
Row = tuple[T, T, T]


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


def rotation_rows(w: T, x: T, y: T, z: T) -> tuple[Row, Row, Row]:
    """Return the rows of a unit quaternion's rotation matrix, of the arguments' type and shape."""
    return (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
