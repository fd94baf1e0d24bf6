"""Estimate the capacity for the lists of the CUDA backend, whose length only the GPU knows, and
retry with fewer views if memory is short.
"""

import math
import threading
from collections import deque
from collections.abc import Callable
from typing import Optional, TypeVar

import torch

from ...core.errors import UserError

HEADROOM = 1.5
STEP = 8192
"""Intersections. Rounding up makes torch's caching allocator reuse blocks; up to 4096 numbers are
sorted by another kernel of torch, which would have to be loaded too."""
MAX_INTERSECTIONS = 2**31 - 1 - STEP  # torch's sort and the kernels use 32-bit indices
DECAY = 0.99  # of the estimate, per call
# per intersection: tile, owner, sorted tile, position, temporaries of the sort, and a row of sums
BACKWARD_BYTES = (4 + 4 + 4 + 8 + 20) + 4 * 12
Result = TypeVar("Result")


def round_up_capacity(intersections: int) -> int:
    """Round a number of intersections up to the next capacity.

    Raises:
        torch.cuda.OutOfMemoryError: the number exceeds 32-bit indices.
    """
    if intersections > MAX_INTERSECTIONS:
        raise torch.cuda.OutOfMemoryError(f"{intersections} intersections")
    return (intersections // STEP + 1) * STEP


class CapacityEstimate:
    """Estimates the intersections per Gaussian from earlier calls with the same size.

    Numbers arrive from the GPU asynchronously. Methods are thread-safe.
    """

    def __init__(self, views: int):
        self.views = views
        self.per_gaussian: Optional[float] = None
        self.failed_capacity = math.inf  # smallest capacity that didn't fit into memory
        self.pending: deque = deque()
        self.lock = threading.Lock()

    def capacity(self, totals, gaussians: int) -> int:
        """Return the capacity for a call.

        Args:
            totals: the call's own numbers of intersections, still being copied from the GPU
                (`stages.AsyncReadback`).
            gaussians: the number of Gaussians.

        Raises:
            torch.cuda.OutOfMemoryError: this capacity has failed before, and there are several
                views, so that parts of them can be tried instead.
        """
        with self.lock:
            self.pending.append((totals, gaussians))
            while self.pending and (self.per_gaussian is None or self.pending[0][0].ready()):
                self._learn(*self.pending.popleft())
            capacity = self._capacity(gaussians)
        if self.views > 1 and capacity >= self.failed_capacity:
            raise torch.cuda.OutOfMemoryError(f"{capacity} intersections")
        return capacity

    def record_failure(self, gaussians: int) -> None:
        """Record that the capacity for this many Gaussians didn't fit into memory."""
        with self.lock:
            self.failed_capacity = min(self.failed_capacity, self._capacity(gaussians))

    def _learn(self, totals, gaussians: int) -> None:
        """Update the estimate: at once to a larger number, slowly to a smaller one."""
        found = sum(totals.values()) / gaussians
        self.per_gaussian = max(DECAY * (self.per_gaussian or 0.0), found)

    def _capacity(self, gaussians: int) -> int:
        expected = math.ceil(self.per_gaussian * gaussians)
        most = min(math.ceil(HEADROOM * expected), MAX_INTERSECTIONS)
        return round_up_capacity(max(expected, most))


def halve_on_oom(work: Callable[[int, int], Result], first: int, last: int) -> list[Result]:
    """Call ``work(first, last)``; if memory is short, call it for each half of the views instead,
    recursively. Return the results in order.

    Raises:
        torch.cuda.OutOfMemoryError: a single view doesn't fit.
    """
    try:
        return [work(first, last)]
    except torch.cuda.OutOfMemoryError:
        if last - first == 1:
            raise
    # Outside the except block, where the traceback would keep the attempt's tensors alive.
    middle = (first + last) // 2
    return halve_on_oom(work, first, middle) + halve_on_oom(work, middle, last)


def too_large(intersections: int) -> UserError:
    """Make the error for a single view that doesn't fit into the GPU's memory."""
    needed = intersections * BACKWARD_BYTES / 2**30
    free = torch.cuda.mem_get_info()[0] / 2**30 if torch.cuda.is_available() else 0.0
    return UserError(
        f"one view's Gaussians overlap {intersections} tiles of the image; their gradients need "
        f"about {needed:.1f} GiB on the GPU, "
        f"of which {free:.1f} GiB are free. Views are already rendered one at a time: use fewer or "
        "smaller Gaussians, a smaller image or preset='fast', or free memory of other programs."
    )
