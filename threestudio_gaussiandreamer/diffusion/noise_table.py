"""A table of standard normal numbers, of which a draw is a slice (Salimans et al. 2017,
arXiv:1703.03864, section 2.1): drawing costs nothing.

Numbers of one draw are independent. Slices of different draws overlap by chance, shifted against
each other, so each pair of numbers is uncorrelated."""

from collections.abc import Sequence
from functools import lru_cache

import torch
from jaxtyping import Float
from torch import Tensor

from ..core import streams

LENGTH = 2**22
"""Numbers in the table at least; 16 MiB."""
SLICES = 16
"""Items that the table holds at least."""
SPREAD = 0.5 * (5**0.5 - 1)
"""Distance of the parts of a step, as a share of the table: the multiples of the golden section,
modulo 1, are far from one another.
"""


class NoiseTable:
    """The numbers, a function of the run's seed.

    Args:
        shape: of one item.
    """

    def __init__(self, seed: int, shape: Sequence[int], device: torch.device | str = "cpu") -> None:
        self.seed, self.shape = seed, torch.Size(shape)
        self._numel = self.shape.numel()
        generator = streams.generator(seed, "noise table")
        length = max(LENGTH, SLICES * self._numel)
        self._values = torch.randn(length, generator=generator).to(device)
        self._places = length - self._numel
        self._strides = torch.empty(1, *self.shape, device="meta").stride()
        self._spread = int(SPREAD * self._places)

    def draw(
        self, stream: str, step: int, first: int, count: int, part: int = 0
    ) -> Float[Tensor, "B *d"]:
        """Return standard normal numbers for ``count`` items, numbered from ``first``, each a
        function of (seed, stream, step, part, item). Most results are views of the table.
        """
        numel, places = self._numel, self._places
        begin = (_start(self.seed, stream, step) + part * self._spread + first * numel) % places
        end = begin + count * numel
        if end - numel < places:
            return self._values.as_strided((count, *self.shape), self._strides, begin)
        begins = (i % places for i in range(begin, end, numel))
        return torch.stack([self._values[i : i + numel].view(self.shape) for i in begins])


@lru_cache(maxsize=1)
def _start(seed: int, stream: str, step: int) -> int:
    """Return where a step's numbers begin; it is the same for all of its parts."""
    return streams.derive_seed(seed, stream, step)
