"""Reduce the number of Gaussians at the same image quality: prune by importance in rounds, and
recover after each round by fitting images of the original.

A large cloud is first pruned at once to the fewest Gaussians with the same images, by the
contribution of each, which rendering the images to be kept has given, and then by importance. Then
duplicates are merged (``merge.py``). Then each round computes the importance in the training views
(``importance.py``), keeps the best 80 %, and fits them to images of the original (``recover.py``).
"""

import functools
import math
from collections.abc import Callable
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.streams import generator
from .densify import highest
from .gaussians import Gaussians
from .importance import importance, removal_error
from .merge import merge_duplicates
from .recover import Recovery, Round
from .views import Views, rasterize_views, row_batches

KEEP = 0.8
"""Smallest fraction that a round keeps."""
SMALLEST_DROP = 0.02
"""The search ends when a round would drop less than this fraction, too little for a recovery."""

LARGE = 100_000
"""Clouds of more Gaussians are first pruned without recovery, whose time is proportional to it."""
LOSSLESS = 50.0
"""PSNR to the original that the first pruning of a large cloud keeps, dB."""
RESERVE = 10.0
"""How far that is above the PSNR of the budget, dB, so that a tenth of the error is spent."""
BISECTIONS = 4
"""Steps that find how far a large cloud can be pruned at once, to within 1/16 of the range."""


class Budget(NamedTuple):
    """Where to stop: at a number of Gaussians, before the PSNR of the validation views falls below
    a bound, dB, or where twice as many would gain ``gain`` dB; at most one of them is given.
    """

    count: Optional[int] = None
    psnr: Optional[float] = None
    gain: Optional[float] = None
    error: float = 1e-4
    """Mean squared error of the input to the ground truth, to which ``gain`` adds that of pruning;
    40 dB where nothing is known of it."""

    def met_by(self, done: Round, before: Round) -> bool:
        """Return whether a round, which began with ``before``, is within the budget."""
        if self.gain is not None:
            errors = [self.error + 10 ** (-0.1 * one.psnr) for one in (before, done)]
            lost = 10 * math.log10(errors[1] / errors[0])
            return lost < self.gain * math.log2(before.count / done.count)
        return self.psnr is None or done.psnr >= self.psnr


@torch.enable_grad()
def view_importance(cloud: Gaussians, views: Views, seed: int = 0) -> Float[Tensor, " N"]:
    """Return the importance of each Gaussian in all views; 0 for those that no view shows."""
    opacities = cloud.logit_opacities.detach().sigmoid().requires_grad_()
    rng = generator(seed, "worth")
    contribution, removal = torch.zeros(2, len(opacities), device=opacities.device)
    for rows in row_batches(views, len(opacities)):
        out = rasterize_views(cloud, views, rows, opacities=opacities)
        contribution = torch.maximum(contribution, out.contribution.amax(0))
        removal = removal + removal_error(out.image, opacities, rng)
    return importance(contribution, removal)


def simplify(
    cloud: Gaussians,
    budget: Budget,
    recovery: Recovery,
    *,
    report: Callable[[Round], None] = lambda done: None,
) -> Gaussians:
    """Prune in rounds down to the smallest cloud that meets the budget.

    Args:
        cloud: the original of ``recovery``.
        recovery: fits the remaining Gaussians after each round, and measures the quality.
        report: called after each round that was kept.

    Raises:
        UserError: no Gaussian is visible in any view, so that they can't be ranked.
    """
    return _Search(budget, recovery, report).run(cloud)


class _Search:
    """State of :func:`simplify`: ``best`` is the round with the smallest cloud so far."""

    def __init__(self, budget: Budget, recovery: Recovery, report: Callable[[Round], None]) -> None:
        self.budget, self.recovery, self.report, self.rounds = budget, recovery, report, 0

    def run(self, cloud: Gaussians) -> Gaussians:
        self._take_unfitted(cloud)
        self._reduce(self.recovery.contribution)
        if not self.scores.any():
            raise UserError(
                f"none of the {len(cloud.means)} Gaussians is visible in any view, so they "
                "can't be ranked"
            )
        if float(self.cloud.sh[:, 0].abs().amax()) > self.recovery.sh_reach:
            self._take(self.recovery(self.cloud, self.rounds))  # colours exceed the file's range
        self._reduce(self.scores)
        self._merge()
        self._prune()
        return self.cloud

    @functools.cached_property
    def scores(self) -> Float[Tensor, " N"]:
        """The importance of the Gaussians, ranked when it is first needed."""
        return view_importance(self.cloud, self.recovery.train_views, self.recovery.seed)

    @property
    def cloud(self) -> Gaussians:
        return self.best.cloud

    def _take(self, best: Round) -> None:
        self.best = best
        self.__dict__.pop("scores", None)

    def _take_unfitted(self, cloud: Gaussians) -> None:
        # only a gain needs its quality, as stored
        unknown = self.budget.gain is None
        self._take(Round(cloud, math.inf if unknown else self.recovery.quality(cloud)))

    def _reduce(self, scores: Float[Tensor, " N"]) -> None:
        """Prune a large cloud at once, as far as its images stay the same without a recovery."""
        if len(self.cloud.means) <= LARGE:
            return
        least = max(LOSSLESS, (self.budget.psnr or 0.0) + RESERVE)

        def same(count: int) -> bool:
            return self.recovery.quality(keep_best(self.cloud, scores, count)) >= least

        high = len(scores)
        low = min(high, self.budget.count or 1)
        if low < high and same(low):
            high = low
        for _ in range(BISECTIONS if low < high else 0):
            middle = (low + high) // 2
            low, high = (low, middle) if same(middle) else (middle, high)
        self._take_unfitted(keep_best(self.cloud, scores, high))

    def _merge(self) -> None:
        values = self.cloud._asdict()
        merged = Gaussians(**merge_duplicates(values, at_least=self.budget.count or 1))
        if len(merged.means) <= (1 - SMALLEST_DROP) * len(self.cloud.means):
            self._try(merged)

    def _prune(self) -> None:
        """Prune in rounds; after a round that is rejected, halve the fraction that a round drops.

        Ends when the next count isn't above the last rejected one, or nothing is left to drop.
        """
        keep, failed = KEEP, 0
        while True:
            here = len(self.cloud.means)
            count = max(int(keep * here), self.budget.count or 1)
            small = self.budget.count is None and count >= (1 - SMALLEST_DROP) * here
            if small or not failed < count < here:
                return
            if self._try(keep_best(self.cloud, self.scores, count)):
                failed = 0
            else:
                keep, failed = 0.5 * (1 + keep), count

    def _try(self, fewer: Gaussians) -> bool:
        """Recover; keep the result if it is within the budget, and return whether it is."""
        done = self.recovery(fewer, self.rounds)
        if not self.budget.met_by(done, self.best):
            return False
        self._take(done)
        self.rounds += 1
        self.report(done)
        return True


def rounds_to(count: int, here: int) -> int:
    """Return how many rounds lead from ``here`` Gaussians to ``count``."""
    rounds = 0
    while here > count:
        here, rounds = max(int(KEEP * here), count), rounds + 1
    return rounds


def keep_best(cloud: Gaussians, scores: Float[Tensor, " N"], count: int) -> Gaussians:
    """Select the ``count`` Gaussians with the highest scores, in their order."""
    return cloud.rows(highest(scores, count))
