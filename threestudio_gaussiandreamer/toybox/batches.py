"""Training batches as functions of (seed, step), made by worker processes where there are some."""

import itertools
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset

from ..core.streams import numpy_generator
from .views import Shards, row_batch

PREFETCHED = 4
"""Batches that each worker process makes in advance."""


@dataclass(frozen=True)
class StepData(Dataset, ABC):
    """The batches of one stage, indexed by step.

    Objects are sent to worker processes, so they hold no networks.
    """

    shards: Shards
    batch: int
    pool: int
    """Number of shards that are visited cyclically."""
    stream: ClassVar[str]
    """Name of the streams of random numbers."""
    per_object: ClassVar[bool] = False
    """Whether rows are objects instead of pictures."""

    def __getitem__(self, step: int) -> Any:
        """Return the batch of ``step``: a tensor, or a named tuple of tensors and numbers, on the
        CPU.
        """
        seed = self.shards.seed
        stream, per_object = f"{self.stream}-rows", self.per_object
        place = row_batch(self.shards, stream, self.batch, self.pool, step, per_object=per_object)
        return self.make(*place, numpy_generator(seed, f"{self.stream}-batch", step))

    @abstractmethod
    def make(self, index: int, rows: np.ndarray, rng: np.random.Generator) -> Any:
        """Make the batch of these rows of shard ``index``."""


@dataclass(frozen=True)
class MixedData(Dataset):
    """One batch in ``every`` of ``first``, the others of ``second``; each gives its batches in its
    own order, without gaps.
    """

    first: StepData
    second: StepData
    every: int

    def __getitem__(self, step: int) -> Any:
        cycle, place = divmod(step, self.every)
        return self.second[cycle * (self.every - 1) + place - 1] if place else self.first[cycle]


def batches(data: Dataset, step: int, device: torch.device, workers: int = 0) -> Iterator[Any]:
    """Yield the batches from ``step`` on, on ``device``.

    Args:
        data: batches on the CPU, indexed by step.
        workers: processes that make batches in advance; with 0 this process makes them.
    """
    loader = DataLoader(
        data,
        batch_size=None,
        sampler=itertools.count(step),  # type: ignore[arg-type]
        num_workers=workers,
        prefetch_factor=PREFETCHED if workers else None,
        pin_memory=device.type == "cuda",
        multiprocessing_context="spawn" if workers else None,
    )
    return (moved(batch, device) for batch in loader)


def moved(batch: Any, device: torch.device) -> Any:
    """Return a tensor, or a named tuple of tensors and numbers, on ``device``."""
    if isinstance(batch, torch.Tensor):
        return batch.to(device, non_blocking=True)
    if isinstance(batch, tuple):
        return type(batch)(*(moved(value, device) for value in batch))
    return batch


def torch_generator(rng: np.random.Generator) -> torch.Generator:
    """Return a torch generator that is seeded by the next number of ``rng``."""
    return torch.Generator().manual_seed(int(rng.integers(2**63)))


def normal(rng: np.random.Generator, shape: Sequence[int]) -> torch.Tensor:
    """Draw standard normal numbers, float32."""
    return torch.from_numpy(rng.standard_normal(tuple(shape), dtype=np.float32))
