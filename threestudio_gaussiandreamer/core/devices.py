"""The device that this process computes on, its threads, and copies between host and GPU that don't
make the host wait for the GPU's earlier work."""

import os
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Any

import torch
from torch import Tensor


def get_device() -> torch.device:
    """Return where parts are built: this process's GPU, or the CPU when none is visible."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    rank = os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0))
    return torch.device("cuda", int(rank))


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use ``count`` threads: one is much faster for thousands of tiny operations."""
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def without_autocast(device_type: str) -> AbstractContextManager:
    """Return a context in which autocast is off; switching takes as long as several operations."""
    is_on = torch.is_autocast_enabled(device_type)
    return torch.autocast(device_type, enabled=False) if is_on else nullcontext()


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
    """Calls functions with values of a GPU when they have arrived, in order; of a CPU at once."""

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
