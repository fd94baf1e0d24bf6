"""What the page of a file of Gaussians shows: the cloud, drawn as its run has drawn it."""

import math
from pathlib import Path
from typing import Optional

from ..core.errors import UserError, unknown
from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import AXES
from ..gaussians.views import NEAR, bounds
from ..splatting import PRESETS
from .page import PageOptions, Shown, decibels, require_page_size
from .poster import WHITE
from .reading import read_any
from .render import RenderSettings
from .run_files import RunFiles, step_of


def cloud_page(
    source: Path,
    *,
    title: Optional[str] = None,
    eps2d: Optional[float] = None,
    preset: Optional[str] = None,
    antialias: Optional[bool] = None,
    bound_colors: Optional[bool] = None,
    background: Optional[str] = None,
    up: Optional[str] = None,
) -> tuple[Shown, PageOptions]:
    """Read a file of Gaussians or a checkpoint, and return what :func:`.page.page` makes of it.

    Options that aren't given are those of the run whose folder contains the file, else defaults.

    Args:
        title: by default the prompt of the run, or the file's name.
        eps2d: screen-space dilation, square pixels.
        preset: of the rasteriser, for the smallest alpha that is drawn.
        background: RRGGBB; by default the run's or white, unless the object would vanish on it.
        up: the axis of the file that is up; by default from the file or its format's convention.

    Raises:
        UserError: an option is invalid, which the message names as the command does; or the file
            can't be read, or has no or too many Gaussians.
    """
    color = None if background is None else _color(background)
    if eps2d is not None and not 0 <= eps2d < 1e6:
        raise UserError(f"--eps2d: expected a number of square pixels from 0 on, got {eps2d:g}")
    if preset is not None and preset not in PRESETS:
        raise unknown("--preset", preset, PRESETS)
    if up is not None and up not in AXES:
        raise unknown("--up", up, AXES)
    stored = read_any(source, up)
    require_page_size(len(stored.gaussians.means), str(source))
    run_files = RunFiles.around(source)
    given = {"eps2d": eps2d, "antialias": antialias, "bound_colors": bound_colors}
    given["alpha_min"] = preset and PRESETS[preset]
    settings = run_files.settings if run_files else _default_settings(stored)
    options = PageOptions(
        title=title or (run_files.prompt if run_files else source.name),
        name=source.stem,
        settings=settings._replace(**{name: x for name, x in given.items() if x is not None}),
        background=color or (run_files and run_files.background) or WHITE,
        keep_background=bool(color or (run_files and run_files.background_is_given)),
    )
    step = step_of(source.resolve().parent)  # the scores are those of the last export
    quality = decibels(run_files.psnr("result", step)) if run_files else ""
    return Shown(stored, "result", quality), options


def _default_settings(stored: StoredCloud) -> RenderSettings:
    """Return the settings for a cloud of unknown units."""
    near = NEAR * bounds(stored.gaussians.tensors())[1]
    return RenderSettings(near=near, far=math.inf, antialias=stored.antialiased)


def _color(text: str) -> tuple[float, float, float]:
    """Parse a colour such as ff8000."""
    try:
        red, green, blue = bytes.fromhex(text.removeprefix("#"))
    except ValueError as error:
        raise UserError(f"--background: expected RRGGBB, such as ff8000, got {text!r}") from error
    return (red / 255, green / 255, blue / 255)
