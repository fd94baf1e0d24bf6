"""Room for the lists of the CUDA backend, whose length only the GPU knows, and what is done where
memory is short.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Optional, TypeVar

import torch

from ...core.errors import UserError

HEADROOM = 1.5
STEP = 4096  # intersections; rounding up lets torch's allocator meet few sizes
MOST = 2**31 - 1 - STEP  # intersections; torch's sort and the kernels' grids count no further
FORGET = 0.99  # how much of a demand is remembered from one call to the next
LIST_BYTES = (
    4 + 4 + 4 + 8 + 20
)  # per intersection: tile, owner, sorted tile, position, and what sorting takes
ROW_BYTES = 4 * 12  # per intersection: the backward pass's row of sums
Result = TypeVar("Result")


def round_up_capacity(intersections: int) -> int:
    """Return a capacity for at least so many intersections.

    Raises:
        torch.cuda.OutOfMemoryError: so many can't be numbered, let alone kept.
    """
    if intersections > MOST:
        raise torch.cuda.OutOfMemoryError(f"{intersections} intersections")
    return (intersections // STEP + 1) * STEP


class CapacityEstimate:
    """How many intersections per Gaussian scenes of one size have needed. Numbers arrive late, and
    any thread may ask.
    """

    def __init__(self, views: int):
        self.views = views
        self.per_gaussian: Optional[float] = None
        self.too_much = math.inf  # the least capacity that there was no memory for
        self.pending: deque = deque()
        self.lock = threading.Lock()

    def capacity(self, totals, gaussians: int) -> int:
        """Return the capacity for a call; ``totals`` (see `stages.AsyncReadback`) will say how many
        intersections it has.

        Raises:
            torch.cuda.OutOfMemoryError: so much has failed before, and there are parts to try
            instead.
        """
        with self.lock:
            self.pending.append((totals, gaussians))
            while self.pending and (self.per_gaussian is None or self.pending[0][0].ready()):
                self._learn(*self.pending.popleft())
            capacity = self._capacity(gaussians)
        if self.views > 1 and capacity >= self.too_much:
            raise torch.cuda.OutOfMemoryError(f"{capacity} intersections")
        return capacity

    def refuse(self, gaussians: int) -> None:
        """Remember that there was no memory for the capacity that was given."""
        with self.lock:
            self.too_much = min(self.too_much, self._capacity(gaussians))

    def _learn(self, totals, gaussians: int) -> None:
        """Follow at once when more is needed, slowly when less is."""
        self.per_gaussian = max(
            FORGET * (self.per_gaussian or 0.0), sum(totals.values()) / gaussians
        )

    def _capacity(self, gaussians: int) -> int:
        expected = math.ceil(self.per_gaussian * gaussians)
        return round_up_capacity(max(expected, min(math.ceil(HEADROOM * expected), MOST)))


def halve_on_oom(work: Callable[[int, int], Result], first: int, last: int) -> list[Result]:
    """Return ``work(first, last)``, or where memory is short for it, that of halves of these views,
    one after another.

    Raises:
        torch.cuda.OutOfMemoryError: a single view doesn't fit either.
    """
    try:
        return [work(first, last)]
    except torch.cuda.OutOfMemoryError:
        if last - first == 1:
            raise
    middle = (
        first + last
    ) // 2  # outside of the handler: the error holds on to what the attempt had allocated
    return halve_on_oom(work, first, middle) + halve_on_oom(work, middle, last)


def too_large(intersections: int) -> UserError:
    """Return the error for one view that doesn't fit alone."""
    needed, free = (
        intersections * (LIST_BYTES + ROW_BYTES) / 2**30,
        torch.cuda.mem_get_info()[0] / 2**30 if torch.cuda.is_available() else 0.0,
    )
    return UserError(
        f"one view's Gaussians reach {intersections} tiles of the picture; their gradients need "
        f"about {needed:.1f} GiB on the GPU, "
        f"of which {free:.1f} GiB are free, though views are drawn one by one already: use "
        "fewer or smaller Gaussians, a smaller picture "
        "or preset='fast', or free memory that something else holds."
    )
