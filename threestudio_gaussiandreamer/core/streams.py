"""Stateless randomness: every draw comes from a generator that is a function of (seed, stream,
step, item).

No generator state is kept, saved or restored, so a run that is stopped anywhere and resumed draws
what the run that never stopped drew, and drawing more in one place (say, rendering more validation
views) changes nothing elsewhere. Draws are made on the CPU and moved, so they don't depend on the
device either."""

import hashlib

import numpy as np
import torch
from torch import Tensor


def derive_seed(seed: int, stream: str, step: int = 0, item: int = 0) -> int:
    """A 63-bit seed for one draw; different (seed, stream, step, item) give independent seeds."""
    digest = hashlib.blake2b(f"{seed}/{stream}/{step}/{item}".encode(), digest_size=8).digest()
    return int.from_bytes(digest, "little") >> 1


def generator(seed: int, stream: str, step: int = 0, item: int = 0) -> torch.Generator:
    """A fresh CPU generator of torch for one draw."""
    return torch.Generator().manual_seed(derive_seed(seed, stream, step, item))


def numpy_generator(seed: int, stream: str, step: int = 0, item: int = 0) -> np.random.Generator:
    """A fresh generator of numpy for one draw."""
    return np.random.default_rng(derive_seed(seed, stream, step, item))


def normal_per_item(
    shape: tuple[int, ...], seed: int, stream: str, step: int, device: torch.device | str = "cpu"
) -> Tensor:
    """Standard normal float32 of ``shape`` (B, ...); item b has its own stream, so it doesn't
    depend on B.
    """
    items = torch.empty(shape)
    for b, item in enumerate(items):
        item.normal_(generator=generator(seed, stream, step, b))
    return items.to(device)
