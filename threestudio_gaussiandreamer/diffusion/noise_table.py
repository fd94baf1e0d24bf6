"""A table of standard normal numbers, of which a draw is a slice (Salimans et al. 2017,
arXiv:1703.03864, section 2.1): drawing costs nothing.

Numbers of one draw are independent. Slices of different draws overlap by chance, shifted against
each other, so each pair of numbers is uncorrelated."""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from ..core import streams

LENGTH = 2**22
"""Numbers in the table at least; 16 MiB."""
SLICES = 16
"""Items that the table holds at least."""


class NoiseTable:
    """The numbers, a function of the run's seed.

    Args:
        numel: the largest number of values of one item.
    """

    def __init__(self, seed: int, numel: int, device: torch.device | str = "cpu") -> None:
        self.seed, self.numel = seed, numel
        generator = streams.generator(seed, "noise table")
        self._values = torch.randn(max(LENGTH, SLICES * numel), generator=generator).to(device)

    def draw(
        self, shape: Sequence[int], stream: str, step: int, items: Sequence[int]
    ) -> list[Float[Tensor, "*d"]]:
        """Return views of standard normal numbers for each item, a function of (seed, stream,
        step, item).

        Args:
            shape: of one item.
        """
        start, places = streams.derive_seed(self.seed, stream, step), len(self._values) - self.numel
        length = torch.Size(shape).numel()
        slices = [(start + item * self.numel) % places for item in items]
        return [self._values[i : i + length].view(shape) for i in slices]
