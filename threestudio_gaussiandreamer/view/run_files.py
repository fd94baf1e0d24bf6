"""Read what a run has left in its folder: configuration, scores, curves, pictures and files.

Nothing here trusts a file: what is missing or damaged is left out."""

import json
import os
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Optional, TypeVar

import yaml

from ..core.errors import UserError
from ..core.files import existing_file, is_folder
from ..core.logs import warn
from ..formats.gaussian_files import holds_gaussians, suffix_of
from .render import RenderSettings

T = TypeVar("T", dict, list)
MAX_BYTES = 4 << 20
"""Largest configuration or file of scores that is read."""


class PlainLoader(yaml.SafeLoader):
    """Loads YAML without aliases, which a ``parsed.yaml`` hasn't and which can expand without
    limit.
    """

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.events.AliasEvent):
            raise yaml.YAMLError("it has an alias")
        return super().compose_node(parent, index)


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
        # only here, since the commands for files need neither Lightning nor the configuration
        from ..host.typed_config import parse_structured
        from ..training.renderer import SplattingRenderer

        try:
            cfg = parse_structured(
                SplattingRenderer.Config, section(self.config, "system", "renderer")
            )
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
        return as_color(color)

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
        """The file of the exported Gaussians, a PLY if there is one; None if there is none."""
        files = sorted(self.export.glob("*.*")) if self.export else []
        found = filter(holds_gaussians, files)
        return min(found, key=lambda file: suffix_of(file.name) != ".ply", default=None)

    def psnr(self, key: str, step: Optional[int] = None) -> Optional[float]:
        """Return dB on held-out views; None if they aren't known.

        Args:
            key: "prior" or "result".
            step: only if it was measured at this step.
        """
        found = section(self.scores, key)
        psnr = found.get("psnr")
        known = isinstance(psnr, float) and step in (None, found.get("step"))
        return psnr if known else None


def cloud_file(path: str | os.PathLike, hint: str = "") -> Path:
    """Return the last exported cloud of a run, or the file of Gaussians or checkpoint itself.

    Args:
        hint: end of the message for a folder.

    Raises:
        UserError: the file is missing, or the folder is no run with an exported cloud.
    """
    if not is_folder(path):
        return existing_file(path, "file of Gaussians or checkpoint")
    folder = Path(path).expanduser()
    found = RunFiles(folder).cloud if is_run(folder) else None
    if found is None:
        raise UserError(
            f"{str(path)!r} is no run with an exported cloud: name a file or a run{hint}"
        )
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


def as_color(value: Any) -> Optional[tuple[float, float, float]]:
    """Return three numbers in [0, 1] as a colour; None for anything else."""
    numbers = value if isinstance(value, (list, tuple)) and len(value) == 3 else ()
    valid = all(isinstance(x, (int, float)) and 0 <= x <= 1 for x in numbers)
    return (float(numbers[0]), float(numbers[1]), float(numbers[2])) if numbers and valid else None


def read_text(path: Path) -> str:
    """Read a text file; an empty text if there is none, it is too large or no UTF-8."""
    try:
        return _text(path)
    except (OSError, ValueError):
        return ""


def read_json(path: Path, kind: type[T]) -> T:
    """Read a JSON file that holds a ``kind``; an empty one if there is none or it is damaged."""
    try:
        content = json.loads(_text(path))
    except (OSError, ValueError, RecursionError):
        return kind()
    return content if isinstance(content, kind) else kind()


def read_yaml(path: Path) -> dict[str, Any]:
    """Read a mapping from a YAML file; an empty one if there is none or it is damaged."""
    try:
        content = PlainLoader(_text(path)).get_single_data()
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return {}
    return content if isinstance(content, dict) else {}


def _text(path: Path) -> str:
    """Read a file of at most ``MAX_BYTES``.

    Raises:
        ValueError: it is larger, or no UTF-8.
    """
    with open(path, "rb") as file:
        content = file.read(MAX_BYTES + 1)
    if len(content) > MAX_BYTES:
        raise ValueError(f"{path} is larger than {MAX_BYTES} bytes")
    return content.decode()
