"""Data-parallel training: the processes share the views of a step equally, and gradients and
statistics are reduced over all of them. Random numbers belong to a view, not to the process that
renders it, so a step is the same as with one process but for the order of floating-point sums."""

from collections.abc import Callable, Iterable

import torch
import torch.distributed as dist
from torch import Tensor


def is_active() -> bool:
    """Return whether this process is one of several."""
    return dist.is_available() and dist.is_initialized() and dist.get_world_size() > 1


def rank() -> int:
    return dist.get_rank() if is_active() else 0


def world_size() -> int:
    return dist.get_world_size() if is_active() else 1


def first_item(count: int) -> int:
    """Return the index, among the views of all processes, of the first of this one's ``count``."""
    return rank() * count


def own_rows(total: int) -> slice:
    """Return which of a step's ``total`` views this process renders."""
    count = total // world_size()
    return slice(first_item(count), first_item(count) + count)


def draw_shared(count: int, draw: Callable[[int], Tensor]) -> Tensor:
    """Call ``draw``, which returns the same numbers in all processes, with the number of all views,
    ``count`` for each process, and return the rows of this one's.
    """
    total = count * world_size()
    return draw(total)[own_rows(total)]


def all_sum(tensor: Tensor, op: str = "SUM") -> Tensor:
    """Sum over all processes, in place."""
    if is_active():
        dist.all_reduce(tensor, op=getattr(dist.ReduceOp, op))
    return tensor


def all_max(tensor: Tensor) -> Tensor:
    """Take the elementwise maximum over all processes, in place."""
    return all_sum(tensor, "MAX")


def average_gradients(parameters: Iterable[torch.nn.Parameter]) -> None:
    """Replace gradients, of which None counts as zero, by their mean over all processes."""
    for parameter in parameters if is_active() else ():
        gradient = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
        parameter.grad = all_sum(gradient) / dist.get_world_size()
