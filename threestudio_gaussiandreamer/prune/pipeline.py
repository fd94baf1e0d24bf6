"""Read a cloud of Gaussians and prune it to a budget.

Three disjoint sets of views are used: Gaussians are ranked and optimised on the training views; the
validation views decide whether a PSNR budget is met, with a margin of two standard errors; the
report measures on the test views. Validation and test views are rendered from the values that a
file of the output format stores, so they include its rounding. All cameras are around the cloud and
look inwards, which suits objects but not rooms."""

import bisect
import logging
import time
from typing import NamedTuple, Optional

import numpy as np
import torch

from ..core.devices import get_device
from ..core.errors import UserError
from ..core.files import existing_file
from ..formats.gaussian_files import StoredCloud, as_stored, file_size
from ..formats.spz import COLOR_REACH
from ..gaussians.axes import rotation_between
from ..gaussians.gaussians import Gaussians
from ..gaussians.recover import Recovery, Round
from ..gaussians.sh import rgb_to_sh0
from ..gaussians.simplify import Budget, rounds_to, simplify
from ..gaussians.views import (
    EPS2D,
    LEAST_ERROR,
    Views,
    bounds,
    views_around,
)
from ..view.run_files import read_any
from .options import (
    PruneOptions,
    budget_of,
    combined_psnr,
    error_of,
    parse_bytes,
    parse_count,
    remaining_psnr_budget,
)

logger = logging.getLogger(__name__)
TRAIN_VIEWS, VAL_VIEWS, TEST_VIEWS = 64, 32, 48
TURNS = (0.0, 45.0, 60.0)
"""Azimuth of the first view of each set, degrees."""


class PruneResult(NamedTuple):
    """A cloud before and after pruning."""

    before: StoredCloud
    after: StoredCloud
    seconds: float
    met: bool = True
    """Whether the budget is met."""


# ---- reading -------------------------------------------------------------------------------------


def read(path: str, up: Optional[str] = None) -> StoredCloud:
    """Read the Gaussians of a file or a checkpoint.

    Args:
        up: overrides the up axis that the file states.

    Raises:
        UserError: there is no such file, or it has no Gaussians or spherical harmonics that can be
            rendered.
    """
    stored = read_any(existing_file(path, "file of Gaussians or checkpoint"), up, "IN")
    if not len(stored.gaussians.means):
        raise UserError(f"{path} holds no Gaussians that can be drawn: there is nothing to prune")
    return stored


# ---- pruning -------------------------------------------------------------------------------------


def prune_to_budget(
    stored: StoredCloud, options: PruneOptions, suffix: str, where: str
) -> PruneResult:
    """Prune a cloud to the budget of ``options``.

    The PSNR to the original cloud, asked for or measured, is stored in the result (``pruned_to``),
    so that pruning again counts from the original.

    Args:
        suffix: of the file to be written, ".ply" or ".spz".
        where: the prefix of options' names in messages.

    Raises:
        UserError: the budget can't be met, or the format can't store the values.
    """
    started = time.perf_counter()
    file_size(stored, suffix)  # raises for values that the format can't store, before any work
    asked = budget_of(options, where, lambda size: _count_within(size, stored, suffix, where))
    after, reached = _simplify(stored, _remaining_budget(asked, stored), options, suffix)
    if options.bytes is not None:
        limit = parse_bytes(options.bytes, f"{where}bytes")
        after, reached = _shrink(stored, after, reached, limit, options, suffix, where)
    spent = _spent(stored, reached)
    met = asked.psnr is None or error_of(spent) <= error_of(asked.psnr) + 2 * LEAST_ERROR
    if not met:
        logger.warning(
            "the budget isn't met: as a %s file these Gaussians reach a PSNR to the original of "
            "at most %.2f dB",
            suffix,
            spent,
        )
    after = after._replace(pruned_to=_psnr_note(stored, after, asked, spent, met))
    return PruneResult(stored, after, time.perf_counter() - started, met)


def _spent(stored: StoredCloud, reached: float) -> float:
    """Return the PSNR to the original of a cloud that has ``reached`` a PSNR to the given one."""
    return reached if stored.pruned_to is None else combined_psnr(stored.pruned_to, reached)


def _psnr_note(
    stored: StoredCloud, after: StoredCloud, asked: Budget, spent: float, met: bool
) -> Optional[float]:
    """Return the PSNR to the original that is stored in the file; None if a cloud that has never
    been pruned keeps all Gaussians.
    """
    if asked.psnr is not None and met:
        return asked.psnr
    unchanged = len(after.gaussians.means) == len(stored.gaussians.means)
    return None if asked.psnr is None and stored.pruned_to is None and unchanged else spent


def _remaining_budget(asked: Budget, stored: StoredCloud) -> Budget:
    """Return the part of a PSNR budget that earlier pruning has not used; if all of it is used, a
    budget that keeps all Gaussians. The error of earlier pruning counts for a gain, too.
    """
    if stored.pruned_to is None:
        return asked
    asked = asked._replace(error=asked.error + error_of(stored.pruned_to))
    if asked.psnr is None:
        return asked
    left = remaining_psnr_budget(asked.psnr, stored.pruned_to)
    if left is not None:
        return Budget(psnr=left)
    print(
        f"no Gaussian is removed: this cloud has been pruned to {stored.pruned_to:g} dB before, as "
        "measured then"
    )
    return Budget(count=len(stored.gaussians.means))


def _count_within(size: int, stored: StoredCloud, suffix: str, where: str) -> int:
    """Return the largest count whose evenly strided subset encodes to at most ``size`` bytes.

    Raises:
        UserError: a single Gaussian takes more.
    """
    whole = len(stored.gaussians.means)

    def bytes_of(count: int) -> int:
        rows = np.arange(count) * whole // count
        return file_size(StoredCloud(stored.gaussians.rows(rows), stored.up), suffix)

    if bytes_of(1) > size:
        raise UserError(
            f"{where}bytes: {size} are too few for one Gaussian, which takes {bytes_of(1)} as "
            f"a {suffix} file"
        )
    return bisect.bisect_left(range(1, whole + 1), True, key=lambda count: bytes_of(count) > size)


def _shrink(
    stored: StoredCloud,
    after: StoredCloud,
    reached: float,
    limit: int,
    options: PruneOptions,
    suffix: str,
    where: str,
) -> tuple[StoredCloud, float]:
    """Prune further until the file, with the note of its PSNR, has at most ``limit`` bytes.

    This is needed because the remaining Gaussians may compress worse than the subset from which the
    count was estimated.
    """
    while (size := file_size(after._replace(pruned_to=_spent(stored, reached)), suffix)) > limit:
        count = len(after.gaussians.means)
        fewer = min(int(count * limit / size), count - 1)
        budget = Budget(count=parse_count(fewer, f"{where}bytes: the number of Gaussians that fit"))
        after, again = _simplify(after, budget, options, suffix)
        reached = combined_psnr(reached, again)
    return after, reached


def _simplify(
    stored: StoredCloud, budget: Budget, options: PruneOptions, suffix: str
) -> tuple[StoredCloud, float]:
    """Prune within a budget; return the cloud, and a lower bound of its stored values' PSNR to the
    given cloud, dB.
    """
    from tqdm import tqdm

    cloud = stored.gaussians.tensors(get_device())
    train_views, val_views, _ = views_of(stored, options)

    def as_read_back(fewer: Gaussians) -> Gaussians:
        file = as_stored(stored._replace(gaussians=fewer.arrays()), suffix)
        return file.gaussians.tensors(get_device())

    recovery = Recovery(
        cloud,
        train_views,
        val_views,
        steps=options.steps,
        as_stored=as_read_back,
        sh_reach=constant_sh_limit(cloud, suffix),
    )
    rounds = None if budget.count is None else rounds_to(budget.count, len(cloud.means))
    with tqdm(desc="pruning", unit="round", total=rounds, disable=None) as bar:

        def report(done: Round) -> None:
            bar.set_postfix_str(f"{done.count} Gaussians, {done.psnr:.2f} dB")
            bar.update()

        fewer = simplify(cloud, budget, recovery, report=report)
    return stored._replace(gaussians=fewer.arrays()), recovery.quality(fewer)


def constant_sh_limit(cloud: Gaussians, suffix: str) -> float:
    """Return the largest absolute coefficient of the constant harmonic that recovery may set.

    Viewers clamp colours to [0, 1], so recovered colours stay in that range, or in the input's if
    it is larger, and within what the file can store.
    """
    largest = max(rgb_to_sh0(1.0), float(cloud.sh[:, 0].abs().amax()))
    return min(largest, COLOR_REACH) if suffix == ".spz" else largest


def views_of(stored: StoredCloud, options: PruneOptions) -> list[Views]:
    """Return training, validation and test views, with the viewer's rendering of ``options``."""
    cloud = stored.gaussians.tensors(get_device())
    to_z_up = torch.from_numpy(rotation_between(stored.up, "z"))
    eps2d, ball = EPS2D if options.eps2d is None else options.eps2d, bounds(cloud)
    return [
        views_around(cloud, count, options.size, turn=turn, to_z_up=to_z_up, ball=ball)._replace(
            eps2d=eps2d, antialias=bool(options.antialias)
        )
        for count, turn in zip((TRAIN_VIEWS, VAL_VIEWS, TEST_VIEWS), TURNS, strict=True)
    ]
