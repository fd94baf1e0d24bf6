"""Write the files that show a run's result: a page with the cloud, a poster and the turntable.

==========================  =======================================================================
file in ``save/``           content
==========================  =======================================================================
it<step>-export/view.html   page for browsers: the cloud, and the initial cloud for comparison
it<step>-export/poster.png  one view with a transparent background
it<step>-test.mp4           the turntable of the test views
it<step>-test.webp          fewer frames as an animated picture, for pages that play no video
prior/gaussians.spz         the initial cloud, before training
==========================  =======================================================================
"""

from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.images import write_animation
from ..exporters.files import read_gaussians
from ..formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from ..gaussians.axes import VIEWER_UP
from ..gaussians.gaussians import Gaussians
from ..host import warn
from ..view.page import MAX_GAUSSIANS, PageOptions, Shown, decibels, page
from ..view.render import WHITE, RenderSettings, first_pose, picture
from ..view.run_files import RunFiles
from .background import FlatBackground
from .renderer import SplattingRenderer

FIRST_CLOUD = "prior/gaussians.spz"
PAGE, POSTER = "view.html", "poster.png"
POSTER_SIZE = 512
"""Pixels each way."""
TURNTABLE_FRAMES, TURNTABLE_SIZE, TURNTABLE_SECONDS = 40, 256, 4.0
"""Of the animated picture: largest number of frames, longest side in pixels, seconds."""


def save_first_cloud(system: Any) -> None:
    """Keep the cloud that training starts with, so that pages can show it beside the result."""
    if _is_cloud(system.geometry) and system.cfg.pages and system.trainer.is_global_zero:
        first = StoredCloud(read_gaussians(system.geometry))
        write_cloud(system.get_save_path(FIRST_CLOUD), first, ".spz")


def write_pages(system: Any, folder: str) -> None:
    """Write the page and the poster of the cloud of ``system``, unless ``system.pages`` is off or a
    page can't show it.

    Args:
        folder: of the exports, below the system's folder of results.
    """
    if not system.cfg.pages or not _is_cloud(system.geometry):
        return
    cloud = StoredCloud(read_gaussians(system.geometry)).in_axes(VIEWER_UP)
    run = RunFiles(Path(system.get_save_dir()).parent)
    options = _page_options(system, run)
    cloud = cloud._replace(antialiased=options.settings.antialias)
    result = Shown(cloud, "result", decibels(run.psnr("result", system.true_global_step)))
    try:
        content = page(result, options, _first_cloud(run))
    except UserError as error:
        warn(f"no {PAGE} is written: {error}")
        return
    with atomic_file(system.get_save_path(f"{folder}/{PAGE}")) as file:
        file.write(content.encode())
    with atomic_file(system.get_save_path(f"{folder}/{POSTER}"), durable=False) as file:
        picture(cloud, options.settings, first_pose(cloud), POSTER_SIZE).save(file, "png")


def turntable_name(system: Any) -> str:
    """Return the name of the folder of test pictures, and of the video without its suffix."""
    return f"it{system.true_global_step}-test"


def discard_turntable(system: Any) -> None:
    """Remove the pictures of an earlier test of the same step, which may have had more views."""
    for path in Path(system.get_save_dir(), turntable_name(system)).glob("*.png"):
        path.unlink(missing_ok=True)  # another test may remove them too


def write_turntable(system: Any) -> None:
    """Write the pictures ``it<step>-test/<number>.png`` as a video, and fewer of them as WebP.

    A video that can't be written is a warning, since the exports follow.
    """
    name = turntable_name(system)
    options = {"save_format": "mp4", "fps": 30, "name": "test", "step": system.true_global_step}
    try:
        system.save_img_sequence(name, name, r"(\d+)\.png", **options)
    except UserError as error:
        warn(str(error))
    folder = Path(system.get_save_dir(), name)
    if not system.cfg.pages:
        return
    # every n-th frame, with n rounded up, so that at most TURNTABLE_FRAMES are left
    frames = sorted(folder.glob("*.png"), key=lambda path: int(path.stem))
    chosen = frames[:: -(-len(frames) // TURNTABLE_FRAMES) or 1]
    if chosen:
        write_animation(folder.with_suffix(".webp"), chosen, TURNTABLE_SIZE, TURNTABLE_SECONDS)


def _page_options(system: Any, run: RunFiles) -> PageOptions:
    settings, bound = RenderSettings(), getattr(system.geometry.cfg, "bound_colors", True)
    if isinstance(system.renderer, SplattingRenderer):
        settings = RenderSettings.of(system.renderer.cfg, bound_colors=bound)
    return PageOptions(
        title=prompt_of(system) or run.folder.name,
        name="gaussians",
        settings=settings,
        background=_background(system.background),
        keep_background=run.background_is_given,
    )


def prompt_of(system: Any) -> str:
    """Return the prompt of a training run, else the text in the configuration."""
    prompt = getattr(system.prompt_utils, "prompt", None)
    return str(prompt or system.cfg.prompt_processor.get("prompt") or "")


def _background(background: Any) -> tuple[float, float, float]:
    """Return the colour that test views are shown on; white for backgrounds that aren't flat."""
    if not FlatBackground.is_flat(background):
        return WHITE
    learned = background.cfg.mode == "learned"
    return tuple(background.color(1)[0].tolist() if learned else background.cfg.color)


def _first_cloud(run: RunFiles) -> Optional[Shown]:
    """Return the cloud that training has started with, if it is there and a page can show it."""
    path = run.save / FIRST_CLOUD
    if not path.is_file():
        return None
    cloud = read_cloud(str(path))
    shown = 0 < len(cloud.gaussians.means) <= MAX_GAUSSIANS
    return Shown(cloud, "prior", decibels(run.psnr("prior"))) if shown else None


def _is_cloud(geometry: Any) -> bool:
    """Return whether a geometry, which may be another extension's, has the Gaussians' fields."""
    return all(hasattr(geometry, name) for name in Gaussians._fields)
