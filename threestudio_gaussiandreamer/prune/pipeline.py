"""Read a cloud of Gaussians, prune it to a budget, and write the report beside the file.

Three disjoint sets of views are used: Gaussians are ranked and optimised on the training views; the
validation views decide whether a PSNR budget is met, with a margin of two standard errors; the
report measures on the test views. Validation and test views are rendered from the values that a
file of the output format stores, so they include its rounding. All cameras are around the cloud and
look inwards, which suits objects but not rooms."""

import bisect
import math
import statistics
import time
from dataclasses import asdict
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ..core.devices import get_device
from ..core.errors import UserError
from ..core.files import existing_file, json_text, write_file
from ..core.logs import warn
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
    psnr_to_original,
    render_all,
    views_around,
)
from ..images import write as write_image
from ..view.run_files import read_any
from .options import PruneOptions, budget_of, combined_psnr, error_of, parse_bytes, parse_count

TRAIN_VIEWS, VAL_VIEWS, TEST_VIEWS = 64, 32, 48
TURNS = (0.0, 45.0, 60.0)
"""Azimuth of the first view of each set, degrees."""
REPORTS = (".json", ".png")
"""Suffixes of the report's files, appended to the name of OUT."""
SHEET_VIEWS, TIMED_VIEWS = 6, 5


class PruneResult(NamedTuple):
    """A cloud before and after pruning."""

    before: StoredCloud
    after: StoredCloud
    seconds: float
    met: bool = True
    """Whether the budget is met."""


def read(path: str, up: Optional[str] = None) -> StoredCloud:
    """Read the Gaussians of a file or a checkpoint; ``up`` overrides the up axis that it states."""
    stored = read_any(existing_file(path, "file of Gaussians or checkpoint"), up, "IN")
    if not len(stored.gaussians.means):
        raise UserError(f"{path} holds no Gaussians that can be drawn: there is nothing to prune")
    return stored


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
    after, reached = _simplify(stored, remaining_budget(asked, stored), options, suffix)
    if options.bytes is not None:
        limit = parse_bytes(options.bytes, f"{where}bytes")
        # what is left may compress worse than the subset from which the count was estimated
        while True:
            size = file_size(after._replace(pruned_to=_spent(stored, reached)), suffix)
            if size <= limit:
                break
            count = len(after.gaussians.means)
            fewer = min(int(count * limit / size), count - 1)
            fewer = parse_count(fewer, f"{where}bytes: the number of Gaussians that fit")
            after, again = _simplify(after, Budget(count=fewer), options, suffix)
            reached = combined_psnr(reached, again)
    spent = _spent(stored, reached)
    met = asked.psnr is None or error_of(spent) <= error_of(asked.psnr) + 2 * LEAST_ERROR
    if not met:
        warn(
            f"the budget isn't met: as a {suffix} file these Gaussians reach a PSNR to the "
            f"original of at most {spent:.2f} dB"
        )
    unchanged = len(after.gaussians.means) == len(stored.gaussians.means)
    if asked.psnr is not None and met:
        spent = asked.psnr
    elif asked.psnr is None and stored.pruned_to is None and unchanged:
        spent = None  # it has never been pruned
    after = after._replace(pruned_to=spent)
    return PruneResult(stored, after, time.perf_counter() - started, met)


def _spent(stored: StoredCloud, reached: float) -> float:
    """Return the PSNR to the original of a cloud that has ``reached`` a PSNR to the given one."""
    return reached if stored.pruned_to is None else combined_psnr(stored.pruned_to, reached)


def remaining_budget(asked: Budget, stored: StoredCloud) -> Budget:
    """Return the part of a PSNR budget that earlier pruning, also an error for a gain, has left."""
    if stored.pruned_to is None:
        return asked
    asked = asked._replace(error=asked.error + error_of(stored.pruned_to))
    if asked.psnr is None:
        return asked
    left = error_of(asked.psnr) - error_of(stored.pruned_to)
    if left > LEAST_ERROR:
        return Budget(psnr=-10 * math.log10(left))
    print(
        f"no Gaussian is removed: this cloud has been pruned to {stored.pruned_to:g} dB before, as "
        "measured then"
    )
    return Budget(count=len(stored.gaussians.means))


def _count_within(size: int, stored: StoredCloud, suffix: str, where: str) -> int:
    """Return the largest count whose evenly strided subset encodes to at most ``size`` bytes."""
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


def _simplify(
    stored: StoredCloud, budget: Budget, options: PruneOptions, suffix: str
) -> tuple[StoredCloud, float]:
    """Prune; return the cloud and a lower bound of its stored values' PSNR to the given one."""
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


def write_report(
    path: str, result: PruneResult, suffix: str, options: PruneOptions
) -> dict[str, Any]:
    """Print the report, write ``path``.json and ``path``.png, and return the content of the JSON.

    Raises:
        UserError: a file can't be written; an existing one is left unchanged.
    """
    views = views_of(result.before, options)[-1]
    grey = views._replace(backgrounds=None)
    shown = grey.rows(torch.linspace(0, len(views.viewmats) - 1, SHEET_VIEWS).long())
    files = [result.before, as_stored(result.after, suffix)]
    clouds = [file.gaussians.tensors(get_device()) for file in files]
    sizes = [file_size(stored, suffix) for stored in (result.before, result.after)]
    before, after = (
        {"gaussians": len(cloud.means), "bytes": size, "ms_per_frame": frame_time(cloud, grey)}
        for cloud, size in zip(clouds, sizes, strict=True)
    )
    quality = psnr_to_original(clouds[1], views, render_all(clouds[0], views))
    report = {"before": before, "after": after, "psnr_on_unseen_views": quality}
    report |= {"met": result.met, "seconds": round(result.seconds, 1)}
    write_file(f"{path}.json", json_text(report | {"options": asdict(options)}, indent=2))
    write_image(f"{path}.png", sheet([render_all(cloud, shown) for cloud in clouds]))
    for name in ("before", "after"):
        count, size, ms = report[name].values()
        cost = f"{count:8d} Gaussians {size / 1e6:8.2f} MB as {suffix} {ms:8.2f} ms a frame"
        print(f"{name:7} {cost}")
    again = result.before.pruned_to is not None
    source = "the input, which had been pruned before" if again else "the original"
    print(f"{quality:.2f} dB to {source}, on the test views; {path}.json, {path}.png")
    return report


def sheet(images: list[Float[Tensor, "V H W 3"]]) -> UInt8[np.ndarray, "rows columns 3"]:
    """Arrange each set of images in a row, as bytes."""
    rows = [torch.cat(list(views), 1) for views in images]
    return (torch.cat(rows, 0).clamp(0, 1).cpu().numpy() * 255).round().astype("uint8")


def frame_time(cloud: Gaussians, views: Views) -> float:
    """Measure how long one view takes to render, milliseconds, the median over five."""
    times = []
    for view in range(min(TIMED_VIEWS, len(views.viewmats))):
        one = views.rows(slice(view, view + 1))
        started = time.perf_counter()
        render_all(cloud, one).sum().item()
        times.append(time.perf_counter() - started)
    return round(1e3 * statistics.median(times), 3)
