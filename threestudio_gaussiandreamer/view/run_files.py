"""Read what a run has left in its folder, and the Gaussians of any file. What is missing or damaged
in a run's folder is left out."""

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Optional, TypeVar

import torch
import yaml
from torch import Tensor

from ..core.checkpoint_file import load_file
from ..core.errors import UserError
from ..core.files import existing_file, is_folder
from ..core.logs import warn
from ..core.options import is_numbers, parse_structured
from ..formats.gaussian_files import (
    READ,
    StoredCloud,
    holds_gaussians,
    read_cloud,
    require_format,
    suffix_of,
)
from ..gaussians.axes import WORLD_UP
from ..gaussians.gaussians import Gaussians, drawable, require_cloud
from .render import RenderSettings

T = TypeVar("T", dict, list)
LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""Ten times faster with libyaml, which a folder of a thousand runs needs."""


@dataclass(frozen=True)
class RunFiles:
    """The folder of a run."""

    folder: Path

    @classmethod
    def around(cls, path: Path) -> Optional["RunFiles"]:
        """Find the run that a file or folder lies in; None if it isn't in one."""
        path = path.resolve()
        return next((cls(folder) for folder in (path, *path.parents) if is_run(folder)), None)

    @property
    def save(self) -> Path:
        return self.folder / "save"

    @cached_property
    def config(self) -> dict[str, Any]:
        """The configuration after merging; empty if it can't be read."""
        return read_yaml(self.folder / "configs" / "parsed.yaml")

    @cached_property
    def scores(self) -> dict[str, Any]:
        """The content of ``metrics.json``; empty if there is none."""
        return read_json(self.save / "metrics.json", dict)

    @property
    def prompt(self) -> str:
        """The prompt, or the name of the folder."""
        prompt = section(self.config, "system", "prompt_processor").get("prompt")
        return str(prompt) if prompt else self.folder.name

    @property
    def settings(self) -> RenderSettings:
        """How the run has drawn its cloud."""
        from ..training.renderer import SplattingRenderer  # files don't need the training

        options = section(self.config, "system", "renderer")
        try:
            cfg = parse_structured(SplattingRenderer.Config, options)
        except UserError as error:
            warn(f"{self.folder}: its renderer's options aren't known here ({error})")
            return RenderSettings()
        bound = section(self.config, "system", "geometry").get("bound_colors", True)
        return RenderSettings.of(cfg, bound_colors=bool(bound))

    @property
    def antialiased(self) -> bool:
        """Whether the run has trained its cloud with antialiasing."""
        return section(self.config, "system", "renderer").get("antialias") is True

    @property
    def background(self) -> Optional[tuple[float, float, float]]:
        """The colour that the run has shown its cloud on; None if it isn't known."""
        color = section(self.config, "system", "background").get("color")
        valid = is_numbers(color, 3) and 0 <= min(color) <= max(color) <= 1
        return tuple(map(float, color)) if valid else None

    @property
    def background_is_given(self) -> bool:
        """Whether a command of the run has set the background."""
        return "system.background.color=" in read_text(self.folder / "cmd.txt")

    @property
    def export(self) -> Optional[Path]:
        """The folder of the exports of the latest step; None if there are none."""
        found = [(step_of(path), path) for path in self.save.glob("it*-export") if path.is_dir()]
        return max(found)[1] if found else None

    @property
    def cloud(self) -> Optional[Path]:
        """The last exported file of Gaussians, a PLY if there is one; None if there is none."""
        rank = lambda file: (step_of(file.parent), suffix_of(file.name) == ".ply")  # noqa: E731
        files = sorted(sorted(self.save.glob("it*-export/*.*")), key=rank, reverse=True)
        return next(filter(holds_gaussians, files), None)

    @property
    def picture(self) -> Optional[Path]:
        """The poster of the last export, else a picture of the last test views or validation."""
        poster = [self.export / "poster.png"] if self.export else []
        views = sorted(self.save.glob("it*-test/0.png"), key=lambda path: step_of(path.parent))
        validations = sorted(self.save.glob("it*.png"), key=step_of)
        found = (*poster, *reversed(views), *reversed(validations))
        return next(filter(Path.is_file, found), None)

    def psnr(self, key: str, step: Optional[int] = None) -> Optional[float]:
        """Return dB of the "prior" or "result" on held-out views; None if unknown at ``step``."""
        found = section(self.scores, key)
        known = isinstance(found.get("psnr"), float) and step in (None, found.get("step"))
        return found["psnr"] if known else None


def cloud_file(path: str | os.PathLike, hint: str = "") -> Path:
    """Return the last exported cloud of a run, or the file of Gaussians or checkpoint itself;
    raises UserError, with ``hint`` at its end, for a folder that is no run with an exported cloud.
    """
    if not is_folder(path):
        return existing_file(path, "file of Gaussians or checkpoint")
    folder = Path(path).expanduser()
    found = RunFiles(folder).cloud if is_run(folder) else None
    if found is None:
        advice = f"name a file or a run{hint}"
        raise UserError(f"{str(path)!r} is no run with an exported cloud: {advice}")
    return found


def step_of(path: Path) -> int:
    """Return the step in the name of a result, ``it<step>-...``; -1 if there is none."""
    found = re.match(r"it(\d+)", path.name)
    return int(found[1]) if found else -1


def is_run(folder: Path) -> bool:
    """Return whether a folder is that of a run; no if it can't be read."""
    try:
        return (folder / "configs" / "parsed.yaml").is_file()
    except OSError:  # no permission, or too long a name
        return False


def section(content: Any, *keys: str) -> Mapping[str, Any]:
    """Return a nested mapping; an empty one if there is none."""
    for key in keys:
        content = content.get(key) if isinstance(content, Mapping) else None
    return content if isinstance(content, Mapping) else {}


def read_text(path: Path) -> str:
    """Read a text file; an empty text if there is none or it is no UTF-8."""
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError):
        return ""


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON file that holds a ``kind``; an empty one if there is none or it is damaged."""
    try:
        content = json.loads(read_text(path))
    except (ValueError, RecursionError):
        return kind()
    return content if isinstance(content, kind) else kind()


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a mapping from a YAML file; an empty one if there is none or it is damaged."""
    try:
        text = read_text(path)
        # a ``parsed.yaml`` has no aliases, which can expand without limit
        if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text, LOADER)):
            return {}
        content = LOADER(text).get_single_data()
    except (ValueError, RecursionError, yaml.YAMLError):
        return {}
    return content if isinstance(content, dict) else {}


# ---- Gaussians -----------------------------------------------------------------------------------

TENSORS = ("means", "quats", "log_scales", "logit_opacities", "sh0", "sh_rest")
GSPLATS = ("means", "quats", "scales", "opacities", "sh0", "shN")
CHECKPOINTS = {
    "state_dict": {name: f"geometry.{name}" for name in TENSORS},
    "splats": dict(zip(TENSORS, GSPLATS, strict=True)),
}
"""The names of the Gaussians' tensors in checkpoints of this package and of gsplat's trainer."""


def read_any(source: Path, up: Optional[str] = None, option: str = "PATH") -> StoredCloud:
    """Read the Gaussians of a file or checkpoint, without those that can't be drawn. A checkpoint
    in the folder of a run was trained with the run's antialiasing.

    Args:
        up: overrides the up axis that the file states.
        option: names the argument in messages.

    Raises:
        UserError: the file is none of Gaussians, or damaged.
    """
    if source.suffix in (".ckpt", ".pt", ".pth"):
        gaussians, run = drawable(from_checkpoint(source), str(source)), RunFiles.around(source)
        antialiased = run is not None and run.antialiased
        return StoredCloud(gaussians, up or WORLD_UP, antialiased=antialiased)
    require_format(source.name, option, READ)
    return read_cloud(str(source), up=up)


def from_checkpoint(file: Path) -> Gaussians:
    """Read the Gaussians of a training checkpoint; raises UserError if it has none."""
    content = load_file(file)
    for key, names in CHECKPOINTS.items():
        state = content.get(key) if isinstance(content, dict) else None
        state = state if isinstance(state, Mapping) else {}
        if all(isinstance(state.get(stored), Tensor) for stored in names.values()):
            require_cloud(state, names, str(file), allow_non_finite=True)
            values = {name: state[stored].detach().float() for name, stored in names.items()}
            harmonics = torch.cat([values.pop("sh0"), values.pop("sh_rest")], 1)
            return Gaussians(sh=harmonics, **values).arrays()
    said = "neither geometry.means nor gsplat's splats"
    raise UserError(f"{file} holds no cloud of Gaussians: {said}")
