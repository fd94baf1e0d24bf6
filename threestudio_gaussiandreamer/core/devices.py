"""The device that this process computes on."""

import os

import torch


def get_device() -> torch.device:
    """Return where parts are built: this process's GPU, or the CPU when none is visible."""
    if not torch.cuda.is_available():
        return torch.device("cpu")
    return torch.device(
        "cuda", int(os.environ.get("LOCAL_RANK", os.environ.get("SLURM_LOCALID", 0)))
    )
