"""Copies between the host and a GPU that don't make the host wait for the GPU's earlier work:
numbers that are logged or counted are read when they have arrived.
"""

from collections import deque
from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor


class HostCopy:
    """A copy of a tensor to the host, which may be under way; of a CPU's the tensor itself."""

    def __init__(self, values: Tensor) -> None:
        self._values, self._arrived = values.detach(), None
        if values.is_cuda:
            self._values = torch.empty(values.shape, dtype=values.dtype, pin_memory=True)
            self._values.copy_(values.detach(), non_blocking=True)
            self._arrived = torch.cuda.Event()
            self._arrived.record(torch.cuda.current_stream(values.device))

    def ready(self) -> bool:
        """Return whether the values have arrived."""
        return self._arrived is None or self._arrived.query()

    def values(self) -> Tensor:
        """Return the values; wait for them if they haven't arrived."""
        if self._arrived is not None:
            self._arrived.synchronize()
        return self._values


class DelayedReads:
    """Calls functions with values of a GPU as soon as they have arrived, in the order of
    submission; with values of a CPU at once.
    """

    def __init__(self) -> None:
        self._pending: deque[tuple[HostCopy, Callable[[Tensor], None]]] = deque()

    def submit(self, values: Tensor, use: Callable[[Tensor], None]) -> None:
        """Call ``use`` with these values, now or in a later call of a method."""
        self._pending.append((HostCopy(values), use))
        self.poll()

    def poll(self, wait: bool = False) -> None:
        """Use the values that have arrived, or with ``wait`` all that have been submitted."""
        while self._pending and (wait or self._pending[0][0].ready()):
            copy, use = self._pending.popleft()
            use(copy.values())


def flush_reads(*parts: Any) -> None:
    """Wait for the values that parts have submitted to their ``reads``, if they have any."""
    for part in parts:
        if isinstance(reads := getattr(part, "reads", None), DelayedReads):
            reads.poll(wait=True)


def to_device(values: Tensor, device: torch.device | str) -> Tensor:
    """Copy a tensor of the host to a device, without waiting for the device's earlier work."""
    if torch.device(device).type != "cuda":
        return values.to(device)
    return values.pin_memory().to(device, non_blocking=True)
