"""Several processes that train one cloud: each renders its own views, gradients and statistics are
combined.

Every function does nothing in a process that trains alone.
"""

from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor


def is_active() -> bool:
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def rank() -> int:
    """The number of this process among those that train together."""
    return dist.get_rank() if is_active() else 0


def all_sum(tensor: Tensor) -> Tensor:
    """The sum over all processes, in place."""
    if is_active():
        dist.all_reduce(tensor, op=dist.ReduceOp.SUM)
    return tensor


def all_max(tensor: Tensor) -> Tensor:
    """The elementwise maximum over all processes, in place."""
    if is_active():
        dist.all_reduce(tensor, op=dist.ReduceOp.MAX)
    return tensor


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Make every process step with the mean gradient, so that the clouds stay equal; a missing
    gradient counts as zero.
    """
    if not is_active():
        return
    for parameter in parameters:
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        parameter.grad = all_sum(gradient) / dist.get_world_size()
