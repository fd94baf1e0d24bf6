"""A number whose gradient is given, and values that are computed when they are read."""

from collections import UserDict
from collections.abc import Callable, Mapping
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


class LazyMapping(UserDict):
    """Values by name; ``later`` are functions of no argument, each called at most once."""

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        self.data, self.later = {**values, **later}, {*later}

    def __getitem__(self, name: str) -> Any:
        if name in self.later:
            self[name] = self.data[name]()
        return self.data[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self.later.discard(name)
        self.data[name] = value
