"""The device that this process computes on, and the number of threads."""

import os
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager, nullcontext

import torch


def get_device() -> torch.device:
    """Return where parts are built: this process's GPU, or the CPU when none is visible."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    rank = os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0))
    return torch.device("cuda", int(rank))


@contextmanager
def torch_threads(count: int) -> Iterator[None]:
    """Let torch use ``count`` threads in this context, and in threads that are started in it.
    Thousands of tiny operations take many times longer with more than one, whose pools wait for one
    another.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def without_autocast(device_type: str) -> AbstractContextManager:
    """Return a context in which autocast is off. Where it is off already, nothing is switched,
    which takes as long as several operations on small tensors.
    """
    if torch.is_autocast_enabled(device_type):
        return torch.autocast(device_type, enabled=False)
    return nullcontext()
