"""Data-parallel training: each process renders its own views; gradients and statistics are reduced
over all processes.

In a single-process run these functions return their input unchanged.
"""

from collections.abc import Iterable

import torch
import torch.distributed as dist
from torch import Tensor


def is_active() -> bool:
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def rank() -> int:
    """Return the rank of this process; 0 in a single-process run."""
    return dist.get_rank() if is_active() else 0


def all_sum(tensor: Tensor) -> Tensor:
    """Sum over all processes, in place."""
    if is_active():
        dist.all_reduce(tensor, op=dist.ReduceOp.SUM)
    return tensor


def all_max(tensor: Tensor) -> Tensor:
    """Take the elementwise maximum over all processes, in place."""
    if is_active():
        dist.all_reduce(tensor, op=dist.ReduceOp.MAX)
    return tensor


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Replace gradients by their mean over all processes, so that the parameters stay identical.

    A gradient that is None counts as zero.
    """
    if not is_active():
        return
    for parameter in parameters:
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        parameter.grad = all_sum(gradient) / dist.get_world_size()
