"""Finished runs, to be judged: where a run's Gaussians and its prompt are, and pictures of them
from any camera.
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError
from ..core.files import existing_file
from ..formats.ply import is_gaussian_ply
from ..gaussians.gaussians import Gaussians
from ..host import find, get_device
from ..launch.config import load_config
from ..prompts.prompt_processors import PROMPT_LIBRARY, resolve_prompt

BLACK = (0.0, 0.0, 0.0)


class Result(NamedTuple):
    """One result of text to 3D."""

    ply: Path
    """The PLY of its Gaussians."""
    prompt: Optional[str]
    """What was asked for, where that is known."""
    background: tuple[float, float, float]
    """The colour that the run looked at it before."""


def find_result(place: str) -> Result:
    """The result in a run's folder, the last that was exported there, or in a PLY file.

    Raises:
        UserError: nothing, or no Gaussians, are there.
    """
    folder = Path(place).expanduser()
    if not folder.is_dir():
        return _checked(
            Result(
                existing_file(place, "result (a run's folder or a PLY of Gaussians)"), None, BLACK
            )
        )
    exported = sorted(folder.glob("save/it*-export/*.ply"), key=_step)
    gaussians = [path for path in exported if is_gaussian_ply(path)]
    if not gaussians:
        raise UserError(
            f"{place!r} is no run's folder with Gaussians in save/it*-export: export it first "
            "(--export), or name a PLY file"
        )
    return Result(gaussians[-1], *_asked_for(folder / "configs" / "parsed.yaml"))


def _step(path: Path) -> tuple[int, str]:
    number = re.match(r"it(\d+)", path.parent.name)
    return int(number[1]) if number else -1, path.name


def _checked(result: Result) -> Result:
    if not is_gaussian_ply(result.ply):
        raise UserError(
            f"{str(result.ply)!r} is no PLY of Gaussians: a run writes one to "
            "save/it*-export/gaussians.ply"
        )
    return result


def _asked_for(parsed: Path) -> tuple[Optional[str], tuple[float, float, float]]:
    """Prompt and background of the run that this configuration describes; none and black where it
    doesn't say.
    """
    if not parsed.is_file():
        return None, BLACK
    system = load_config(parsed).system
    color = (system.get("background") or {}).get("color") or BLACK
    return _prompt_of(system.get("prompt_processor") or {}), tuple(float(value) for value in color)


def _prompt_of(processor: Mapping[str, Any]) -> Optional[str]:
    try:
        return (
            resolve_prompt(
                processor.get("prompt") or "", processor.get("prompt_library", PROMPT_LIBRARY)
            )
            or None
        )
    except UserError:  # its library isn't there any more: who needs the text has to give it
        return None


def read_result(result: Result) -> Gaussians:
    """All attributes of a result's Gaussians; rows that can't be drawn are left out."""
    return find("gaussians-prior")({"path": str(result.ply)}).gaussians("")


class Pictures:
    """Renders a cloud as validation does: our rasteriser, a flat background, no gradients."""

    def __init__(self, arrays: Gaussians, background: tuple[float, float, float] = BLACK) -> None:
        geometry = find("gaussiandreamer-cloud")({"sh_degree": math.isqrt(arrays.sh.shape[1]) - 1})
        geometry.set_arrays(**arrays._asdict())
        behind = find("gaussiandreamer-background")({"color": list(background)})
        renderer = find("gaussiandreamer-splatting")(
            {}, geometry=geometry, material=None, background=behind
        )
        self._renderer = renderer.to(get_device()).eval()
        geometry.to(get_device())
        behind.to(get_device()).eval()

    def render(
        self, c2w: Float[Tensor, "V 4 4"], fovy: Float[Tensor, " V"], size: int, *, chunk: int = 4
    ) -> Iterator[Float[np.ndarray, "B H W 3"]]:
        """The views in [0, 1], ``chunk`` at a time; ``fovy`` in radians, ``size`` pixels each
        way.
        """
        for views, angles in zip(c2w.split(chunk), fovy.split(chunk), strict=True):
            yield self._render(views, angles, size)

    @torch.no_grad()
    def _render(
        self, c2w: Float[Tensor, "B 4 4"], fovy: Float[Tensor, " B"], size: int
    ) -> Float[np.ndarray, "B H W 3"]:
        return self._renderer(c2w, fovy, size, size)["comp_rgb"].clamp(0, 1).cpu().numpy()
