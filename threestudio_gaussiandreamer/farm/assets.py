"""One asset of a farm: the launcher's arguments that make it, its folder, and its result.

``result.json`` is the last file that is written into an asset's folder: a worker takes an asset for
finished if and only if it is there. It holds the digest of the exported files, which a single run
of the same arguments reproduces."""

import hashlib
import json
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from ..core.files import atomic_file, json_text
from ..launch.run_folder import program_anywhere
from .rows import Row

RESULT = "result.json"
ASSETS = "assets"
"""The ``name`` of the assets' runs, and so the folder that holds one folder per asset."""
NOT_EXPORTED = (".json", ".html", ".png")
"""Reports and pages beside the exported files, which may hold times."""
PICTURES = ("it*-export/poster.png", "it*-test/0.png", "it*.png")
MANAGED = {
    "exp_root_dir": "--out",
    "name": "--out",
    "tag": "the column name",
    "timestamp": "the farm",
    "use_timestamp": "the farm",
    "resume": "the farm, which resumes by itself",
    "system.prompt_processor.prompt": "the prompt list",
    "system.prompt_processor.prompt_file": "the prompt list",
}
"""Options that a farm sets, and what to use instead of an override."""


class Source(NamedTuple):
    """A YAML file as it was read when the farm was started."""

    name: str
    content: bytes


class Recipe(NamedTuple):
    """What all assets of a farm have in common."""

    sources: tuple[Source, ...]
    overrides: tuple[str, ...]
    cpu: bool
    """Whether the assets are made on the CPU."""
    cores: int
    """Threads of an asset. On the CPU the last bits of a result depend on it."""
    low_memory: Optional[Source] = None
    """Laid over the sources for an asset for which the memory didn't suffice; None: not valid
    with them."""


class Job(NamedTuple):
    """One row and what is needed to make its asset."""

    row: Row
    sources: tuple[Source, ...] = ()
    """The YAML files of the row's column ``config``."""
    saves_memory: bool = False
    """Whether the low-memory configuration is laid over the others."""


def launch_arguments(recipe: Recipe, job: Job, configs: list[str], folder: Path) -> list[str]:
    """Return the launcher's arguments for an asset.

    Args:
        configs: the paths of the YAML files.
        folder: of the farm; the asset's is ``folder/assets/<name>``.
    """
    return [
        *(text for path in configs for text in ("--config", path)),
        "--train",
        *(["--gpu", "cpu"] if recipe.cpu else []),
        *run_overrides(recipe, job),
        f"exp_root_dir={folder}",
        f"name={ASSETS}",
        f"tag={job.row.name}",
        "use_timestamp=false",
        "resume=auto",
    ]


def run_overrides(recipe: Recipe, job: Job) -> list[str]:
    """Return the overrides that an asset depends on."""
    seed = [] if job.row.seed is None else [f"seed={job.row.seed}"]
    prompt = f"system.prompt_processor.prompt={job.row.prompt}"
    return [*recipe.overrides, *job.row.overrides, *seed, prompt]


def all_sources(recipe: Recipe, job: Job) -> list[Source]:
    """Return the YAML files of an asset, later ones taking precedence."""
    extra = [recipe.low_memory] if job.saves_memory and recipe.low_memory else []
    return [*recipe.sources, *job.sources, *extra]


def repeat_command(recipe: Recipe, job: Job) -> str:
    """Return the command that makes an asset by itself, in ``outputs/``."""
    configs = [text for source in all_sources(recipe, job) for text in ("--config", source.name)]
    device = ["--gpu", "cpu"] if recipe.cpu else []
    command = [*program_anywhere(), *configs, "--train", *device, *run_overrides(recipe, job)]
    return f"OMP_NUM_THREADS={recipe.cores} {shlex.join(command)}"


def asset_folder(folder: Path, row: Row) -> Path:
    return folder / ASSETS / row.name


# Results
# --------------------------------------------------------------------------------------------------


def write_result(folder: Path, result: dict[str, Any]) -> None:
    with atomic_file(folder / RESULT) as file:
        file.write(json_text(result, indent=1).encode())


def parse_result(content: bytes, row: Row) -> Optional[dict[str, Any]]:
    """Return the content of a ``result.json``; None if it isn't one of this row."""
    try:
        result = json.loads(content)
    except ValueError:
        return None
    ours = isinstance(result, dict) and result.get("key") == row.key
    return result if ours and has_files(result) else None


def has_files(result: dict[str, Any]) -> bool:
    """Return whether a result names anything that was made; without it an asset isn't finished."""
    return "files" not in result or any(map(result.get, ("files", "picture", "page")))


def read_result(folder: Path, row: Row) -> Optional[dict[str, Any]]:
    """Return the result of an asset that is finished; None otherwise."""
    try:
        return parse_result((folder / RESULT).read_bytes(), row)
    except OSError:
        return None


def exported(folder: Path) -> Iterator[Path]:
    """Yield the exported files of an asset, sorted."""
    found = folder.glob("save/it*-export/**/*")
    yield from sorted(p for p in found if p.is_file() and p.suffix not in NOT_EXPORTED)


def digest(folder: Path) -> str:
    """Return the digest of the names and contents of the exported files."""
    total = hashlib.sha256()
    for path in exported(folder):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return total.hexdigest()


def picture(folder: Path) -> Optional[str]:
    """Return the path, relative to ``folder``, of the picture that a gallery shows."""
    return next(filter(None, (newest(folder, pattern) for pattern in PICTURES)), None)


def newest(folder: Path, pattern: str) -> Optional[str]:
    """Return the last of the files below ``save`` with this pattern, relative to ``folder``."""
    found = sorted(folder.glob(f"save/{pattern}"))
    return found[-1].relative_to(folder).as_posix() if found else None


def stored_bytes(folder: Path) -> int:
    """Return the size of all files of an asset, checkpoints included."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())


def scores(folder: Path) -> dict[str, float]:
    """Return the numbers that a run has measured on its result."""
    try:
        measured = json.loads((folder / "save" / "metrics.json").read_bytes())["result"]
    except (OSError, ValueError, KeyError, TypeError):
        return {}
    names = ("psnr", "ssim", "multi_face")
    return {name: measured[name] for name in names if isinstance(measured.get(name), (int, float))}
