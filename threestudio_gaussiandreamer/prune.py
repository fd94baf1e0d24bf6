"""Prune a finished cloud to a budget: ``python -m threestudio_gaussiandreamer.prune IN OUT --psnr 40``.

IN is a PLY of Gaussians, ours or any other tool's, or a checkpoint of ours; OUT a PLY. Beside OUT are written OUT.json, the report,
and OUT.png, before (top) and after. The method: ``simplify.py``. Three sets of views, none in another: what Gaussians are scored on
and fitted to, what decides whether a budget of quality is met, and what the report says.

A budget of quality is spent once: it is noted in the PLY, and a second run with the same or a stricter one has nothing to do, since
it would measure against the pruned cloud.
"""

import argparse
import json
import math
import re
import statistics
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple, Optional

import torch
from torch import Tensor

from .builtin.pictures import write as write_picture
from .builtin.weights import load_checkpoint
from .errors import UserError
from .files import existing_file
from .host import get_device
from .ply import read_comments, read_gaussians, write_gaussians
from .simplify import Budget, Cloud, Round, Views, likeness, look, simplify, views_around

NOTE = "pruned to the likeness, dB:"
PROBES, JUDGES, TESTS = 64, 16, 16
HEADER_BYTES = 2048
"""More than the header of the PLY takes."""
TURNS = (0.0, 45.0, 60.0)
"""Where the three spirals of views start, degrees."""
CLOUD_KEYS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "sh_rest")


class Report(NamedTuple):
    """What a cloud is, and what it costs."""

    gaussians: int
    bytes: int
    ms_per_frame: float


def main(argv: Optional[Sequence[str]] = None) -> int:
    """Run one command line; returns the exit code: 0 done, 2 something the user can mend."""
    try:
        args = parse(argv)
    except SystemExit as stop:
        return int(stop.code or 0)
    try:
        run(args)
    except UserError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def parse(argv: Optional[Sequence[str]]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(prog="python -m threestudio_gaussiandreamer.prune", description=__doc__.splitlines()[0])
    parser.add_argument("source", metavar="IN", help="a PLY of Gaussians or a checkpoint")
    parser.add_argument("output", metavar="OUT", help="the PLY to write")
    budget = parser.add_mutually_exclusive_group(required=True)
    budget.add_argument("--count", help="how many Gaussians to keep")
    budget.add_argument("--bytes", help="the largest size of OUT, such as 500kB or 2MB")
    budget.add_argument("--psnr", help="how like the pruned cloud has to look, dB to the views of the unpruned one, such as 40")
    budget.add_argument("--within", help="what the pruned cloud may lose against the truth, such as 0.1dB: see --quality")
    parser.add_argument("--quality", type=float, default=35.0, help="dB of the unpruned cloud to the truth, for --within (default: 35)")
    parser.add_argument("--size", type=int, default=256, help="pixels of the views each way (default: 256)")
    parser.add_argument("--steps", type=int, default=60, help="of recovery after each round (default: 60)")
    return parser.parse_args(argv)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Everything, in the order in which mistakes show; returns the report."""
    cloud, spent = read(args.source)
    budget = budget_of(args, cloud)
    if args.size < 16 or args.steps < 1:
        raise UserError(f"--size and --steps: expected at least 16 and 1, got {args.size} and {args.steps}")
    require_writable(Path(args.output))
    probes, judges, tests = (views_around(cloud, n, args.size, turn=turn) for n, turn in zip((PROBES, JUDGES, TESTS), TURNS, strict=True))
    enough = budget.psnr is not None and spent is not None and budget.psnr >= spent
    started = time.perf_counter()
    pruned = cloud if enough else pruned_with_progress(cloud, probes, judges, budget, args.steps)
    seconds = time.perf_counter() - started
    if enough:
        print(f"nothing to do: {args.source} has been pruned to {spent:g} dB already")
    note = budget.psnr if not enough else spent
    write_gaussians(args.output, **arrays_of(pruned), comments=[] if note is None else [f"{NOTE} {note:g}"])
    return write_report(args, cloud, pruned, tests, seconds)


# ---- reading ---------------------------------------------------------------------------------------------------------------


def read(path: str) -> tuple[Cloud, Optional[float]]:
    """The cloud on the device that renders, and the likeness in dB that it has been pruned to before, if it has.

    Raises:
        UserError: there is no file, it holds no Gaussians, or fewer than two.
    """
    file = existing_file(path, "PLY of Gaussians or checkpoint")
    values = from_checkpoint(file) if file.suffix == ".ckpt" else read_gaussians(file)._asdict()
    cloud = Cloud(*(torch.as_tensor(values[name]).float().to(get_device()) for name in Cloud._fields))
    if len(cloud.means) < 2:
        raise UserError(f"{path} holds {len(cloud.means)} Gaussians: there is nothing to prune")
    notes = [] if file.suffix == ".ckpt" else [line for line in read_comments(file) if line.startswith(NOTE)]
    return cloud, number(notes[-1].removeprefix(NOTE), "the note in the PLY") if notes else None


def from_checkpoint(file: Path) -> dict[str, Tensor]:
    """The cloud in a training checkpoint."""
    state = load_checkpoint(file)["state_dict"]
    values = {name: state.get(f"geometry.{name}") for name in CLOUD_KEYS}
    if missing := [name for name, value in values.items() if value is None]:
        raise UserError(f"{file} holds no cloud of Gaussians: it has no geometry.{missing[0]}")
    return values | {"sh": torch.cat([values["sh0"], values["sh_rest"]], 1)}


def budget_of(args: argparse.Namespace, cloud: Cloud) -> Budget:
    """What the options ask for.

    Raises:
        UserError: a number that makes no sense.
    """
    if args.count is not None:
        return Budget(count=counted(number(args.count, "--count"), "--count"))
    if args.bytes is not None:
        return Budget(count=counted((size_in_bytes(args.bytes) - HEADER_BYTES) // bytes_of(cloud, 1), "--bytes, in Gaussians,"))
    if args.psnr is not None:
        return Budget(psnr=positive(number(args.psnr, "--psnr", "dB"), "--psnr"))
    return Budget(psnr=likeness_within(positive(number(args.within, "--within", "dB"), "--within"), args.quality))


def number(text: str, option: str, unit: str = "") -> float:
    try:
        value = float(re.sub(rf"\s*{unit}$", "", text.strip(), flags=re.IGNORECASE))
    except ValueError:
        value = math.nan
    if not math.isfinite(value):
        raise UserError(f"{option}: expected a number, got {text.strip()!r}")
    return value


def positive(value: float, option: str) -> float:
    if value <= 0:
        raise UserError(f"{option}: expected a number above 0, got {value:g}")
    return value


def counted(value: float, option: str) -> int:
    if value < 1 or value != int(value):
        raise UserError(f"{option}: expected a whole number from 1 on, got {value:g}")
    return int(value)


def size_in_bytes(text: str) -> int:
    found = re.fullmatch(r"\s*([\d.]+)\s*(k|m|g)?b?\s*", text.lower())
    if not found:
        raise UserError(f"--bytes: expected a size such as 500kB or 2MB, got {text!r}")
    return int(number(found[1], "--bytes") * 1000 ** ("kmg".index(found[2]) + 1 if found[2] else 0))


def bytes_of(cloud: Cloud, count: int) -> int:
    """The size of a PLY of ``count`` of these Gaussians, without its header: float32 of all attributes and of three unused normals."""
    return 4 * (3 + sum(values[0].numel() for values in cloud)) * count


def likeness_within(loss: float, quality: float) -> float:
    """The PSNR to the unpruned cloud at which a cloud of ``quality`` dB to the truth loses ``loss`` dB.

    Both errors are taken to be independent, so their squares add: 10^(loss/10) = 1 + 10^((quality - likeness)/10).
    """
    return quality - 10 * math.log10(10 ** (loss / 10) - 1)


def require_writable(output: Path) -> None:
    if output.suffix != ".ply":
        raise UserError(f"OUT: expected the name of a .ply file, got {str(output)!r}")
    if not output.parent.is_dir():
        raise UserError(f"OUT: there is no folder {str(output.parent)!r}")


# ---- working and telling ---------------------------------------------------------------------------------------------------


def pruned_with_progress(cloud: Cloud, probes: Views, judges: Views, budget: Budget, steps: int) -> Cloud:
    from tqdm import tqdm

    with tqdm(desc="pruning", unit="round", disable=None) as bar:

        def report(done: Round) -> None:
            bar.set_postfix_str(f"{done.count} Gaussians, {done.psnr:.2f} dB")
            bar.update()

        return simplify(cloud, probes, judges, budget, steps=steps, report=report)


def arrays_of(cloud: Cloud) -> dict[str, Any]:
    return {name: values.detach().cpu().numpy() for name, values in cloud._asdict().items()}


def write_report(args: argparse.Namespace, before: Cloud, after: Cloud, tests: Views, seconds: float) -> dict[str, Any]:
    """The table on the screen, OUT.json and OUT.png."""
    pictures = [look(cloud, tests)[0] for cloud in (before, after)]
    costs = [Report(len(cloud.means), bytes_of(cloud, len(cloud.means)), frame_time(cloud, tests)) for cloud in (before, after)]
    reached = likeness(after, tests, pictures[0])
    report = {"before": costs[0]._asdict(), "after": costs[1]._asdict(), "psnr_on_unseen_views": reached, "seconds": round(seconds, 1)}
    Path(f"{args.output}.json").write_text(json.dumps(report | {"command": vars(args)}, indent=2))
    shown = [torch.cat(list(images[:: max(1, len(images) // 6)][:6]), 1) for images in pictures]
    sheet = torch.cat(shown, 0).clamp(0, 1)
    write_picture(Path(f"{args.output}.png"), (sheet.cpu().numpy() * 255).round().astype("uint8"))
    for name, cost in zip(("before", "after"), costs, strict=True):
        print(f"{name:7} {cost.gaussians:8d} Gaussians {cost.bytes / 1e6:8.2f} MB {cost.ms_per_frame:8.2f} ms a frame")
    print(f"{reached:.2f} dB to the unpruned cloud on views that nothing was fitted to; {args.output}, .json, .png")
    return report


def frame_time(cloud: Cloud, views: Views) -> float:
    """Milliseconds of one view, the median."""
    times = []
    for view in range(min(5, len(views.viewmats))):
        one = Views(views.viewmats[view : view + 1], views.Ks[view : view + 1], views.positions[view : view + 1], views.size)
        started = time.perf_counter()
        look(cloud, one)[0].sum().item()
        times.append(time.perf_counter() - started)
    return round(1e3 * statistics.median(times), 3)


if __name__ == "__main__":
    sys.exit(main())
