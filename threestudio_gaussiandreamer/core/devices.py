"""The device that this process computes on, and the number of threads."""

import os
from collections.abc import Iterator
from contextlib import contextmanager

import torch


def get_device() -> torch.device:
    """Return where parts are built: this process's GPU, or the CPU when none is visible."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device(
        "cuda", int(os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0)))
    )


@contextmanager
def one_thread() -> Iterator[None]:
    """Limit torch to one thread in this context, and in threads that are started in it. Thousands
    of tiny operations take many times longer with more, whose pools wait for one another.
    """
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
