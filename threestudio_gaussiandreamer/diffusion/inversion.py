"""DDIM inversion, the trajectory from a clean latent to noise, and noise that its steps may add."""

from collections.abc import Callable, Sequence
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..core import streams
from .sds import ddim_factors, per_item

LENGTH = 2**22
"""Numbers in a table at least; 16 MiB."""
SLICES = 16
"""Items that a table holds at least."""
SPREAD = 0.5 * (5**0.5 - 1)
"""Distance of the parts of a step, as a share of the table: the multiples of the golden section,
modulo 1, are far from one another.
"""


class Step(NamedTuple):
    """The items of a batch that one step of an inversion moves to larger noise."""

    index: int
    rows: Int[Tensor, " R"]
    """Indices of the items."""
    z: Float[Tensor, "R c h w"]
    t: Int[Tensor, " R"]
    """The timestep of z, before the step."""


def invert(
    predict: Callable[[Step], Float[Tensor, "R c h w"]],
    x: Float[Tensor, "B c h w"],
    t: Int[Tensor, " B"],
    alphas_cumprod: Float[Tensor, " T"],
    stride: int,
    *,
    eta: float = 0.0,
    fresh: Optional[Callable[[int], Float[Tensor, "B c h w"]]] = None,
) -> Float[Tensor, "B c h w"]:
    """Follow DDIM (Song et al. 2021, eq. 12 with eta 0) from x, taken as the latent of timestep 0,
    to each item's timestep t.

    Args:
        predict: returns the noise in the latents of a step.
        x: float32 or float64.
        alphas_cumprod: abar by timestep.
        stride: timesteps of one step; the last one ends at t.
        eta: standard deviation of the noise that a step adds, as a share of that of DDPM's reverse
            step (Song et al. 2021, eq. 16), as threestudio's SDI does.
        fresh: returns a step's standard normal noise of all items, by its index; for ``eta`` > 0.
    """
    # in this order, the items that have ended are always the first
    ends, rows = t.cpu().sort(stable=True)
    left = rows = rows.to(x.device)
    abar, z, ended = alphas_cumprod.cpu(), x.index_select(0, rows), []
    starts = torch.arange(0, int(ends[-1]), stride)[:, None]
    now, later = abar[starts], abar[torch.minimum(ends, starts + stride)]
    variance = (1 - now) / (1 - later) * (1 - later / now)
    deviation = eta * variance.clamp_min(0).sqrt()
    # one copy for all steps and items: one in each step would wait for a GPU
    factors = torch.stack([*ddim_factors(now, later), deviation], dim=1).to(x)
    for index, of_step in enumerate(factors):
        start = index * stride
        gone = int((ends <= start).sum())
        ended.append(z[:gone])
        ends, left, z = ends[gone:], left[gone:], z[gone:]
        ratio, slope, deviation = (per_item(values, x) for values in of_step[:, -len(z) :])
        predicted = predict(Step(index, left, z, torch.full_like(left, start)))
        z = (z * ratio).addcmul_(predicted, slope)
        if eta and fresh is not None:
            z.addcmul_(fresh(index).to(x)[left], deviation)
    return torch.empty_like(x).index_copy_(0, rows, torch.cat([*ended, z]))


class NoiseTable:
    """A table of standard normal numbers, a function of the run's seed, of which a draw is a slice
    (Salimans et al. 2017, arXiv:1703.03864, section 2.1): a draw is mostly a view.

    Numbers of one draw are independent. Slices of different draws overlap by chance, shifted
    against each other, so each pair of numbers is uncorrelated.

    Args:
        shape: of one item.
    """

    def __init__(self, seed: int, shape: Sequence[int], device: torch.device | str = "cpu") -> None:
        self.seed, self.shape = seed, torch.Size(shape)
        length = max(LENGTH, SLICES * self.shape.numel())
        generator = streams.generator(seed, "noise table")
        self._values = torch.randn(length, generator=generator).to(device)

    def draw(
        self, stream: str, step: int, first: int, count: int, part: int = 0
    ) -> Float[Tensor, "B *d"]:
        """Return standard normal numbers for ``count`` items, numbered from ``first``, each a
        function of (seed, stream, step, part, item).
        """
        numel = self.shape.numel()
        places = len(self._values) - numel
        begin = streams.derive_seed(self.seed, stream, step) + part * int(SPREAD * places)
        begins = [(begin + item * numel) % places for item in range(first, first + count)]
        if begins[-1] - begins[0] == (count - 1) * numel:
            return self._values[begins[0] : begins[-1] + numel].view(count, *self.shape)
        return torch.stack([self._values[i : i + numel].view(self.shape) for i in begins])
