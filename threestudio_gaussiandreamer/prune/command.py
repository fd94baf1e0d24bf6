"""Prune a finished cloud to a budget: ``python -m threestudio_gaussiandreamer.prune.command IN OUT
--psnr 40``.

IN is a PLY or SPZ file of Gaussians, ours or any other tool's, or a checkpoint, ours or gsplat's;
OUT a PLY or SPZ file. From PLY to PLY the axes stay as they are; otherwise a PLY is written -y up,
as viewers expect it. Beside OUT are written OUT.json, the report, and OUT.png, before (top) and
after. The method: ``simplify.py``. Three sets of views, none in another: what Gaussians are scored
on and fitted to, what decides whether a budget of quality is met (two standard errors on the safe
side), and what the report says. Both of the latter look at what OUT gives back, rounding included.
The views are from around and outside: right for an object, not for a room.

A budget of quality is spent once: it is noted in OUT, and a second run has what is left of it,
since it measures against the pruned cloud: nothing of the same budget or a stricter one."""

import argparse
import bisect
import logging
import math
import os
import re
import signal
import statistics
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from torch import Tensor

from ..core.checkpoint_file import load_file
from ..core.errors import UserError
from ..core.files import atomic_file, existing_file, json_text, require_writable
from ..core.images import write as write_picture
from ..core.options import at_least, check_options, in_range
from ..formats.gaussian_files import (
    StoredCloud,
    as_stored,
    file_size,
    read_cloud,
    require_format,
    write_cloud,
)
from ..formats.spz import COLOR_REACH
from ..gaussians.axes import AXES, VIEWER_UP, WORLD_UP, rotation_between
from ..gaussians.gaussians import Gaussians, drawable
from ..gaussians.simplify import (
    EPS2D,
    LEAST_ERROR,
    Budget,
    Round,
    Views,
    assured_likeness,
    likeness,
    look,
    rounds_to,
    simplify,
    views_around,
)
from ..host import get_device

logger = logging.getLogger(__name__)
PROBES, JUDGES, TESTS = 64, 32, 48
TURNS = (0.0, 45.0, 60.0)
"""Where the three spirals of views start, degrees."""
CHECKPOINTS = {
    "state_dict": {
        name: f"geometry.{name}"
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh0", "sh_rest")
    },
    "splats": {
        "means": "means",
        "quats": "quats",
        "log_scales": "scales",
        "logit_opacities": "opacities",
        "sh0": "sh0",
        "sh_rest": "shN",
    },
}
"""Where the cloud is in a checkpoint of ours, and of gsplat's trainer."""
REPORTS = (".json", ".png")
"""What is written beside OUT: their names are OUT's and these endings."""
BUDGETS = ("count", "bytes", "psnr", "within")
LOSSES = (1e-3, 30.0)
"""What may be asked of ``within``, dB."""


@dataclass
class PruneOptions:
    """A budget, at most one of the first four, and how it is met."""

    count: Any = None
    bytes: Any = None
    psnr: Any = None
    within: Any = None
    quality: float = field(default=35.0, metadata=in_range(-200, 200, "dB"))
    size: int = field(default=256, metadata=in_range(16, 4096, "pixels"))
    steps: int = field(default=60, metadata=in_range(1, 100_000))
    eps2d: Optional[float] = field(default=None, metadata=at_least(0, "square pixels"))
    antialias: Optional[bool] = None

    @property
    def asked_for(self) -> bool:
        return any(getattr(self, name) is not None for name in BUDGETS)

    @staticmethod
    def check(cfg: Any) -> None:
        given = [name for name in BUDGETS if getattr(cfg, name) is not None]
        if len(given) > 1:
            raise UserError(f"{given[1]}: give one budget; {given[0]} is one too")
        budget_of(cfg, "")


class Pruned(NamedTuple):
    """A cloud before and after, and the seconds between."""

    before: StoredCloud
    after: StoredCloud
    seconds: float
    met: bool = True
    """Whether the budget is."""


class Cost(NamedTuple):
    """What a cloud is, and what it costs."""

    gaussians: int
    bytes: int
    ms_per_frame: float


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line; returns the exit code: 0 done, 2 something the user can mend, 130
    Ctrl-C.
    """
    try:
        args = parse(argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        run(args)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print("stopped", file=sys.stderr)
        return 128 + signal.SIGINT
    return 0


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="python -m threestudio_gaussiandreamer.prune.command",
        description="Prune a finished cloud of Gaussians to a budget; beside OUT: OUT.json, "
        "the report, and OUT.png, before and after.",
    )
    parser.add_argument(
        "source", metavar="IN", help="a PLY or SPZ file of Gaussians, or a checkpoint"
    )
    parser.add_argument("output", metavar="OUT", help="the PLY or SPZ file to write")
    budget = parser.add_argument_group("the budget, one of").add_mutually_exclusive_group(
        required=True
    )
    budget.add_argument("--count", help="how many Gaussians to keep")
    budget.add_argument("--bytes", help="the largest size of OUT, such as 500kB or 2MB")
    budget.add_argument(
        "--psnr",
        help="how like the pruned cloud has to look, dB to the views of the unpruned one, such "
        "as 40",
    )
    budget.add_argument(
        "--within",
        help="what the pruned cloud may lose against the truth, such as 0.1dB: see --quality",
    )
    parser.add_argument(
        "--quality",
        type=float,
        default=35.0,
        help="dB of the unpruned cloud to the truth, for --within (default: 35)",
    )
    parser.add_argument(
        "--size",
        type=int,
        default=256,
        help="pixels each way of the views, for which all dB hold (default: 256)",
    )
    parser.add_argument(
        "--steps", type=int, default=60, help="of recovery after each round (default: 60)"
    )
    parser.add_argument(
        "--eps2d",
        type=float,
        default=EPS2D,
        help=f"judge as viewers that widen Gaussians by so many square pixels ({EPS2D:g})",
    )
    parser.add_argument(
        "--antialias",
        action="store_true",
        help="judge as viewers that keep the energy of small Gaussians",
    )
    parser.add_argument(
        "--up",
        choices=AXES,
        help="which axis of IN is up (default: what the file says, else the custom of its format)",
    )
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Everything, in the order in which mistakes show; returns the report."""
    options = PruneOptions(
        **{option.name: getattr(args, option.name) for option in fields(PruneOptions)}
    )
    check_options(PruneOptions, options, "--")
    suffix = require_format(args.output, "OUT")
    for ending in ("", *REPORTS):
        require_writable(args.output + ending, f"OUT{ending}")
    if (
        Path(args.output).exists()
        and Path(args.source).exists()
        and os.path.samefile(args.source, args.output)
    ):
        raise UserError("OUT is IN: give it another name, so that the unpruned cloud is kept")
    stored = read(args.source, args.up)
    if suffix == ".ply" and Path(args.source).suffix.lower() != ".ply":
        stored = stored.in_axes(VIEWER_UP)  # from a PLY, the axes stay as they are
    done = pruned(stored, options, suffix, "--")
    write_cloud(args.output, done.after)
    return write_report(args.output, done, suffix, options)


# ---- reading -------------------------------------------------------------------------------------


def read(path: str, up: Optional[str] = None) -> StoredCloud:
    """The cloud in a file or checkpoint.

    Raises:
        UserError: there is no file, it holds no Gaussians, fewer than two, or harmonics that can't
            be drawn.
    """
    file = existing_file(path, "file of Gaussians or checkpoint")
    checkpoint = file.suffix in (".ckpt", ".pt", ".pth")
    stored = (
        StoredCloud(drawable(from_checkpoint(file), path), up or WORLD_UP)
        if checkpoint
        else read_cloud(path, up=up)
    )
    if len(stored.gaussians.means) < 2:
        raise UserError(
            f"{path} holds {len(stored.gaussians.means)} Gaussians that can be drawn: there is "
            "nothing to prune"
        )
    return stored


def from_checkpoint(file: Path) -> Gaussians:
    """The cloud in a training checkpoint."""
    content = load_file(file)
    for key, names in CHECKPOINTS.items():
        state = content.get(key, {}) if isinstance(content, dict) else {}
        if all(isinstance(state.get(stored), Tensor) for stored in names.values()):
            values = {
                name: state[stored].detach().float().cpu().numpy() for name, stored in names.items()
            }
            harmonics = torch.cat(
                [torch.from_numpy(values.pop(name)) for name in ("sh0", "sh_rest")], 1
            ).numpy()
            return Gaussians(sh=harmonics, **values)
    raise UserError(
        f"{file} holds no cloud of Gaussians: neither our {CHECKPOINTS['state_dict']['means']} "
        "nor gsplat's splats are there"
    )


def budget_of(
    options: PruneOptions, where: str, fitting: Callable[[int], int] = lambda size: size
) -> Budget:
    """What the options ask for; ``fitting`` tells how many Gaussians go into so many bytes.

    Raises:
        UserError: a number that makes no sense.
    """
    if options.count is not None:
        return Budget(count=counted(number(options.count, f"{where}count"), f"{where}count"))
    if options.bytes is not None:
        return Budget(
            count=counted(
                fitting(size_in_bytes(options.bytes, f"{where}bytes")),
                f"{where}bytes, in Gaussians,",
            )
        )
    if options.psnr is not None:
        return Budget(psnr=positive(number(options.psnr, f"{where}psnr", "dB"), f"{where}psnr"))
    if options.within is not None:
        loss = number(options.within, f"{where}within", "dB")
        if not LOSSES[0] <= loss <= LOSSES[1]:
            raise UserError(
                f"{where}within: expected a loss from {LOSSES[0]:g} to {LOSSES[1]:g} dB, got "
                f"{loss:g}"
            )
        return Budget(psnr=likeness_within(loss, options.quality))
    return Budget()


def number(value: Any, option: str, unit: str = "") -> float:
    text = str(value).strip()
    try:
        found = float(re.sub(rf"\s*{unit}$", "", text, flags=re.IGNORECASE))
    except ValueError:
        found = math.nan
    if not math.isfinite(found):
        raise UserError(f"{option}: expected a number, got {text!r}")
    return found


def positive(value: float, option: str) -> float:
    if value <= 0:
        raise UserError(f"{option}: expected a number above 0, got {value:g}")
    return value


def counted(value: float, option: str) -> int:
    if value < 1 or value != int(value):
        raise UserError(f"{option}: expected a whole number from 1 on, got {value:g}")
    return int(value)


def size_in_bytes(value: Any, option: str) -> int:
    found = re.fullmatch(r"\s*([\d.]+)\s*(k|m|g)?b?\s*", str(value).lower())
    if not found:
        raise UserError(f"{option}: expected a size such as 500kB or 2MB, got {str(value)!r}")
    return int(number(found[1], option) * 1000 ** ("kmg".index(found[2]) + 1 if found[2] else 0))


def likeness_within(loss: float, quality: float) -> float:
    """The PSNR to the unpruned cloud at which a cloud of ``quality`` dB to the truth loses ``loss``
    dB.

    Both errors are taken to be independent, so their squares add: 10^(loss/10) = 1 + 10^((quality -
      likeness)/10).
    """
    return quality - 10 * math.log10(10 ** (loss / 10) - 1)


def unspent(asked: float, spent: float) -> Optional[float]:
    """The PSNR to a cloud pruned to ``spent`` dB at which that is still ``asked`` dB like the
    first; None where nothing is left.

    Both errors are taken to be independent, so their squares add.
    """
    left = _error(asked) - _error(spent)
    return -10 * math.log10(left) if left > LEAST_ERROR else None


def spent_together(*likenesses: float) -> float:
    """The PSNR after several losses, taken to be independent."""
    return -10 * math.log10(sum(map(_error, likenesses)))


def _error(likeness: float) -> float:
    """The mean squared error of a PSNR, the least that is measured or more."""
    return max(10 ** (-likeness / 10), LEAST_ERROR)


# ---- working -------------------------------------------------------------------------------------


def pruned(stored: StoredCloud, options: PruneOptions, suffix: str, where: str) -> Pruned:
    """The cloud within its budget as a file of the format ``suffix``; what an earlier run has spent
    of a quality isn't spent again.

    Raises:
        UserError: a budget that can't be met, or values that the format can't hold.
    """
    started, whole = time.perf_counter(), len(stored.gaussians.means)
    file_size(stored, suffix)  # says what the format can't hold before any work
    asked = budget_of(options, where, lambda size: _most_within(size, stored, suffix, where))
    after, reached = _simplified(stored, _rest_of(asked, stored), options, suffix)
    while options.bytes is not None and (size := file_size(after, suffix)) > (
        limit := size_in_bytes(options.bytes, f"{where}bytes")
    ):
        # what is left packs worse than it did among the others
        fewer = min(int(len(after.gaussians.means) * limit / size), len(after.gaussians.means) - 1)
        after, reached = _simplified(
            after, Budget(count=counted(fewer, f"{where}bytes, in Gaussians,")), options, suffix
        )
    spent = reached if stored.pruned_to is None else spent_together(stored.pruned_to, reached)
    met = asked.psnr is None or _error(spent) <= _error(asked.psnr) + 2 * LEAST_ERROR
    if not met:
        logger.warning(
            "the budget isn't met: as a %s file no cloud of these Gaussians is more than %.2f "
            "dB like the first",
            suffix,
            spent,
        )
    if asked.psnr is not None:
        note = asked.psnr if met else spent
    else:
        note = (
            spent if stored.pruned_to is not None and len(after.gaussians.means) == whole else None
        )
    return Pruned(stored, after._replace(pruned_to=note), time.perf_counter() - started, met)


def _rest_of(asked: Budget, stored: StoredCloud) -> Budget:
    """What an earlier run has left of a budget of quality: maybe nothing, so that all Gaussians
    stay.
    """
    if asked.psnr is None or stored.pruned_to is None:
        return asked
    left = unspent(asked.psnr, stored.pruned_to)
    if left is not None:
        return Budget(psnr=left)
    print(
        f"no Gaussian goes: this cloud has been pruned to {stored.pruned_to:g} dB already, as "
        "it was judged then"
    )
    return Budget(count=len(stored.gaussians.means))


def _most_within(size: int, stored: StoredCloud, suffix: str, where: str) -> int:
    """How many Gaussians make a file of at most ``size`` bytes: the most whose every so manyth, as
    they are, does.
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


def _simplified(
    stored: StoredCloud, budget: Budget, options: PruneOptions, suffix: str
) -> tuple[StoredCloud, float]:
    """The cloud within a budget, and how like the given one it is as a file, in views that nothing
    was fitted to.
    """
    from tqdm import tqdm

    cloud = tensors_of(stored)
    probes, judges, _ = views_of(stored, options)
    sh_reach = COLOR_REACH if suffix == ".spz" else math.inf
    rounds = None if budget.count is None else rounds_to(budget.count, len(cloud.means))
    with tqdm(desc="pruning", unit="round", total=rounds, disable=None) as bar:

        def report(done: Round) -> None:
            bar.set_postfix_str(f"{done.count} Gaussians, {done.psnr:.2f} dB")
            bar.update()

        def written(fewer: Gaussians) -> Gaussians:
            return tensors_of(as_stored(stored_cloud(fewer, stored), suffix))

        fewer = simplify(
            cloud,
            probes,
            judges,
            budget,
            steps=options.steps,
            report=report,
            stored=written,
            sh_reach=sh_reach,
        )
    return stored_cloud(fewer, stored), assured_likeness(
        written(fewer), judges, look(cloud, judges)
    )


def views_of(stored: StoredCloud, options: PruneOptions) -> list[Views]:
    """What is fitted to, what decides, what is reported; drawn as the options say that viewers
    draw.
    """
    cloud, to_z_up = tensors_of(stored), torch.from_numpy(rotation_between(stored.up, "z"))
    drawn = {
        "eps2d": EPS2D if options.eps2d is None else options.eps2d,
        "antialias": bool(options.antialias),
    }
    series = zip((PROBES, JUDGES, TESTS), TURNS, strict=True)
    return [
        views_around(cloud, n, options.size, turn=turn, to_z_up=to_z_up)._replace(**drawn)
        for n, turn in series
    ]


def tensors_of(stored: StoredCloud) -> Gaussians:
    """The cloud on the device that renders."""
    return stored.gaussians.tensors(get_device())


def stored_cloud(cloud: Gaussians, like: Optional[StoredCloud] = None) -> StoredCloud:
    """A cloud to be written, with the axes of another one or our own."""
    gaussians = cloud.arrays()
    return StoredCloud(gaussians) if like is None else like._replace(gaussians=gaussians)


# ---- telling -------------------------------------------------------------------------------------


def write_report(path: str, done: Pruned, suffix: str, options: PruneOptions) -> dict[str, Any]:
    """The table on the screen, ``path``.json and ``path``.png; returns what the JSON holds."""
    tests = views_of(done.before, options)[-1]
    clouds = [tensors_of(done.before), tensors_of(as_stored(done.after, suffix))]
    grey = tests._replace(backgrounds=None)
    sizes = [file_size(done.before, suffix), file_size(done.after, suffix)]
    costs = [
        Cost(len(cloud.means), size, frame_time(cloud, grey))
        for cloud, size in zip(clouds, sizes, strict=True)
    ]
    reached = likeness(clouds[1], tests, look(clouds[0], tests))
    report = {
        "before": costs[0]._asdict(),
        "after": costs[1]._asdict(),
        "psnr_on_unseen_views": reached,
        "met": done.met,
        "seconds": round(done.seconds, 1),
    }
    with atomic_file(f"{path}.json") as file:
        file.write(json_text(report | {"options": asdict(options)}, indent=2).encode())
    write_picture(Path(f"{path}.png"), sheet([look(cloud, grey) for cloud in clouds]))
    for name, cost in zip(("before", "after"), costs, strict=True):
        print(
            f"{name:7} {cost.gaussians:8d} Gaussians {cost.bytes / 1e6:8.2f} MB as {suffix} "
            f"{cost.ms_per_frame:8.2f} ms a frame"
        )
    print(
        f"{reached:.2f} dB to what it was before, on views that nothing was fitted to; "
        f"{path}.json, {path}.png"
    )
    return report


def sheet(pictures: list[Tensor]) -> Any:
    """Six views from below to above in a row, a row for each cloud, as bytes."""
    rows = [
        torch.cat(list(images[torch.linspace(0, len(images) - 1, 6).long()]), 1)
        for images in pictures
    ]
    return (torch.cat(rows, 0).clamp(0, 1).cpu().numpy() * 255).round().astype("uint8")


def frame_time(cloud: Gaussians, views: Views) -> float:
    """Milliseconds of one view, the median."""
    times = []
    for view in range(min(5, len(views.viewmats))):
        row = slice(view, view + 1)
        one = views._replace(
            viewmats=views.viewmats[row], Ks=views.Ks[row], positions=views.positions[row]
        )
        started = time.perf_counter()
        look(cloud, one).sum().item()
        times.append(time.perf_counter() - started)
    return round(1e3 * statistics.median(times), 3)
