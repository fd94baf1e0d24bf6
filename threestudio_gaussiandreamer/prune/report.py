"""Measure a pruned cloud on the test views, and write the report beside the file."""

import statistics
import time
from dataclasses import asdict
from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Float, UInt8
from numpy import ndarray
from torch import Tensor

from ..core.devices import get_device
from ..core.files import atomic_file, json_text
from ..core.images import write as write_image
from ..formats.gaussian_files import as_stored, file_size
from ..gaussians.gaussians import Gaussians
from ..gaussians.views import Views, psnr_to_original, render_all
from .options import PruneOptions
from .pipeline import PruneResult, views_of

REPORTS = (".json", ".png")
"""Suffixes of the report's files, appended to the name of OUT."""
SHEET_VIEWS, TIMED_VIEWS = 6, 5


class Cost(NamedTuple):
    """Size and rendering cost of a cloud."""

    gaussians: int
    bytes: int
    ms_per_frame: float


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
    before, after = (_cost(*item, grey) for item in zip(clouds, sizes, strict=True))
    report = {
        "before": before._asdict(),
        "after": after._asdict(),
        "psnr_on_unseen_views": psnr_to_original(clouds[1], views, render_all(clouds[0], views)),
        "met": result.met,
        "seconds": round(result.seconds, 1),
    }
    with atomic_file(f"{path}.json") as file:
        file.write(json_text(report | {"options": asdict(options)}, indent=2).encode())
    write_image(f"{path}.png", sheet([render_all(cloud, shown) for cloud in clouds]))
    _print_report(path, report, before, after, suffix, result.before.pruned_to)
    return report


def _print_report(
    path: str,
    report: dict[str, Any],
    before: Cost,
    after: Cost,
    suffix: str,
    pruned_to: Optional[float],
) -> None:
    for name, cost in (("before", before), ("after", after)):
        print(
            f"{name:7} {cost.gaussians:8d} Gaussians {cost.bytes / 1e6:8.2f} MB as {suffix} "
            f"{cost.ms_per_frame:8.2f} ms a frame"
        )
    source = "the original" if pruned_to is None else "the input, which had been pruned before"
    print(
        f"{report['psnr_on_unseen_views']:.2f} dB to {source}, on the test views; "
        f"{path}.json, {path}.png"
    )


def _cost(cloud: Gaussians, size: int, views: Views) -> Cost:
    return Cost(len(cloud.means), size, frame_time(cloud, views))


def sheet(images: list[Float[Tensor, "V H W 3"]]) -> UInt8[ndarray, "rows columns 3"]:
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
