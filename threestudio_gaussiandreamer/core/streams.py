"""Stateless random numbers: every draw comes from a generator that is a function of (seed, stream,
step, item), so a resumed run draws the same numbers, and draws in one place don't change those
elsewhere. Numbers are drawn on the CPU, so they don't depend on the device."""

import hashlib
from typing import Any

import numpy as np
import torch
from torch import Tensor

from .devices import to_device


def derive_seed(seed: int, stream: str, step: int = 0, item: int = 0) -> int:
    """Return a 63-bit seed that is a hash of (seed, stream, step, item)."""
    digest = hashlib.blake2b(f"{seed}/{stream}/{step}/{item}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def generator(seed: int, stream: str, step: int = 0, item: int = 0) -> torch.Generator:
    """Return a new torch CPU generator, seeded by :func:`derive_seed`."""
    return torch.Generator().manual_seed(derive_seed(seed, stream, step, item))


def numpy_generator(seed: int, stream: str, step: int = 0, item: int = 0) -> np.random.Generator:
    """Return a new NumPy generator, seeded by :func:`derive_seed`."""
    return np.random.default_rng(derive_seed(seed, stream, step, item))


def normal_per_item(
    shape: tuple[int, ...], seed: int, stream: str, step: int, device: Any = "cpu", first: int = 0
) -> Tensor:
    """Draw standard normal numbers (float32) of ``shape`` (B, ...). Each of the B items, which are
    numbered from ``first``, has its own stream, so its numbers don't depend on B.
    """
    items = torch.empty(shape)
    for b, item in enumerate(items, first):
        item.normal_(generator=generator(seed, stream, step, b))
    return to_device(items, device)
