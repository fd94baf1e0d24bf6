"""Find the Gaussians and the prompts of finished runs, and render them from any camera."""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.checkpoint_file import load_module_weights
from ..core.errors import UserError
from ..core.files import existing_file
from ..formats.gaussian_files import is_antialiased
from ..formats.ply import is_gaussian_ply
from ..gaussians.gaussians import Gaussians
from ..host import find, get_device, warn
from ..launch.config import load_config
from ..prompts.prompt_processors import resolve_prompt
from ..view.run_files import RunFiles

BLACK = (0.0, 0.0, 0.0)
FLAT = ("gaussiandreamer-background", "solid-color-background")
"""Backgrounds of one colour."""


class Result(NamedTuple):
    """The result of one text-to-3D run."""

    file: Path
    """The file of its Gaussians."""
    prompt: Optional[str]
    """The prompt of the run; None if it is unknown."""
    background: tuple[float, float, float]
    """The background colour of the run, RGB in [0, 1]."""
    antialiased: bool = False
    """Whether it was trained with antialiasing, and so has to be drawn with it."""


def find_result(place: str) -> Result:
    """Find a run's last export, or take a PLY; raise UserError if missing or without Gaussians."""
    folder = Path(place).expanduser()
    if not folder.is_dir():
        file = existing_file(place, "result (a run's folder or a PLY of Gaussians)")
        if not is_gaussian_ply(file):
            where = "a run writes one to save/it*-export/gaussians.ply"
            raise UserError(f"{str(file)!r} is no PLY of Gaussians: {where}")
        return Result(file, None, BLACK, is_antialiased(file))
    run = RunFiles(folder)
    if not run.cloud:
        said = "export it first (--export system.exporter.formats=[ply]), or name a PLY file"
        raise UserError(f"{place!r} is no run's folder with Gaussians in save/it*-export: {said}")
    prompt, color, parsed = None, BLACK, folder / "configs" / "parsed.yaml"
    if parsed.is_file():
        system = load_config(parsed).system
        color = _background_of(system, folder)
        # without its prompt library, the prompt can be given as an option
        with contextlib.suppress(UserError):
            prompt = resolve_prompt((system.get("prompt_processor") or {}).get("prompt") or "")
    return Result(run.cloud, prompt, tuple(map(float, color)), run.antialiased)


def _background_of(system: Mapping[str, Any], folder: Path) -> Sequence[float]:
    """Return the colour of a run's background; a learned one is that of its last checkpoint."""
    options, last = system.get("background") or {}, folder / "ckpts" / "last.ckpt"
    kind, color = system.get("background_type") or FLAT[0], options.get("color") or BLACK
    if kind in FLAT:
        background = find(kind)(options)
        if next(background.parameters(), None) is None:
            return background.cfg.color
        if last.is_file():
            background.load_state_dict(load_module_weights(str(last), "background")[0])
            return background(torch.zeros(1, 1, 1, 3))[0, 0, 0].tolist()
    warn(f"{folder}: the colour {list(color)} is used in place of the background of its training")
    return color


def read_result(result: Result) -> Gaussians:
    """Read all attributes of a result's Gaussians; rows that can't be rendered are skipped."""
    return find("gaussians-prior")({"path": str(result.file)}).gaussians("")


def render_views(
    arrays: Gaussians,
    c2w: Float[Tensor, "V 4 4"],
    fovy: Float[Tensor, " V"],
    size: int,
    *,
    background: tuple[float, float, float] = BLACK,
    antialias: bool = False,
    chunk: int = 4,
) -> Iterator[Float[np.ndarray, "B H W 3"]]:
    """Yield renders in [0, 1] with this package's rasteriser and its default options, ``chunk``
    views at a time, ``size`` pixels each way; ``fovy`` is vertical, radians.
    """
    geometry = find("gaussiandreamer-cloud")({"sh_degree": math.isqrt(arrays.sh.shape[1]) - 1})
    geometry.set_arrays(**arrays._asdict())
    backdrop = find("gaussiandreamer-background")({"color": list(background)})
    parts = {"geometry": geometry, "material": None, "background": backdrop}
    renderer = find("gaussiandreamer-splatting")({"antialias": antialias}, **parts)
    for part in (geometry, backdrop, renderer):
        part.to(get_device()).eval()
    for views, angles in zip(c2w.split(chunk), fovy.split(chunk), strict=True):
        with torch.no_grad():  # no decorator, which --typecheck would hide the generator from
            found = renderer(views, angles, size, size)["comp_rgb"]
        yield found.clamp(0, 1).cpu().numpy()
