"""What the assets of a farm are made with: its configuration and those of the rows, the launcher's
arguments for an asset, and ``farm.json``, which tells one farm from another."""

import hashlib
import json
import shlex
from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import NamedTuple, Optional

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from tqdm import tqdm

from .. import __version__
from ..core.errors import UserError
from ..launch.config import read_source, read_yaml
from ..launch.options import find_config
from ..launch.run_folder import program_anywhere
from .place import CHANGED, FINISHED, AnotherRow, Place
from .rows import Row, read_rows

FARM = "farm.json"
OF_MACHINES = ("device", "cores")
"""Entries of ``farm.json`` that are known only when Ray has told which machines there are."""
LOW_MEMORY = "gaussiandreamer-lowmem.yaml"
MOST_CHECKS = 500
"""So many combinations of rows' ``config`` and ``overrides`` are checked before any work, and
further ones when it is their turn."""
HERE = "exp_root_dir=outputs"
"""Of a single run; the farm's may be a URL, which the launcher refuses."""
MANAGED = {
    **dict.fromkeys(("exp_root_dir", "name"), "--out"),
    "tag": "the column name",
    **dict.fromkeys(("timestamp", "use_timestamp", "resume"), "the farm, which resumes by itself"),
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
    """For assets for which the memory didn't suffice; None: it isn't valid over the sources."""


class Job(NamedTuple):
    """One attempt to make the asset of a row."""

    row: Row
    sources: tuple[Source, ...] = ()
    """The YAML files of the row."""
    saves_memory: bool = False
    """Whether the low-memory configuration is laid over the others."""
    spent: float = 0.0
    """Seconds of workers in earlier attempts."""
    handed_out: float = 0.0
    """When a worker got it, seconds since 1970."""

    def worker_seconds(self, now: float) -> float:
        """Return the seconds of workers in all attempts, which end ``now``."""
        return round(self.spent + max(now - self.handed_out, 0.0), 3)


@cache
def read_config(name: str) -> Source:
    """Read a YAML file by its path, or by its name as the launcher does; once in a process."""
    path = find_config(name)
    return Source(str(path), read_source(path))


def job_of(row: Row, spent: float = 0.0, saves_memory: bool = False) -> Job:
    """Return the job of a row, with its YAML files."""
    return Job(row, tuple(map(read_config, row.config)), saves_memory, spent)


def root_of(configs: Iterable[str]) -> str:
    """Return ``exp_root_dir`` of the configuration: the folder or URL for the farm's folder."""
    roots = [read_yaml(read_config(name).name).get("exp_root_dir") for name in configs]
    root = next(filter(None, reversed(roots)), "outputs")
    try:  # it may be that of a variable of the environment
        return str(OmegaConf.create([root])[0])
    except OmegaConfBaseException as error:
        raise UserError(f"exp_root_dir is {root!r}, which isn't known here: give --out") from error


def launch_arguments(recipe: Recipe, job: Job, configs: Iterable[str], *where: str) -> list[str]:
    """Return the launcher's arguments for an asset, of which ``where`` says where the run is."""
    device = ["--gpu", "cpu"] if recipe.cpu else []
    paths = [text for path in configs for text in ("--config", path)]
    return [*paths, "--train", *device, *run_overrides(recipe, job), *where]


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
    configs = [source.name for source in all_sources(recipe, job)]
    command = [*program_anywhere(), *launch_arguments(recipe, job, configs, HERE)]
    return f"OMP_NUM_THREADS={recipe.cores} {shlex.join(command)}"


def check_recipe(recipe: Recipe, rows: Iterable[Row]) -> Recipe:
    """Check all rows; return the recipe, with the low-memory configuration if that is valid."""
    from .. import register_parts
    from ..launch.parts import load_extensions

    register_parts()
    load_extensions()
    checked: dict[tuple, Job] = {}
    for row in rows:
        kind = row.config, row.overrides
        try:
            for override in (*recipe.overrides, *row.overrides):
                if (key := override.partition("=")[0]) in MANAGED:
                    raise UserError(f"{key} is set by {MANAGED[key]}: remove {override[:80]!r}")
            job = job_of(row)
            if kind not in checked and len(checked) < MOST_CHECKS:
                checked[kind] = job
                check_job(recipe, job)
        except UserError as error:
            if any(kind):
                raise UserError(f"line {row.line} of the prompt list: {error}") from error
            raise
    try:
        saving = recipe._replace(low_memory=read_config(LOW_MEMORY))
        check_job(saving, next(iter(checked.values()))._replace(saves_memory=True))
    except UserError:
        return recipe
    return saving


def check_job(recipe: Recipe, job: Job) -> None:
    """Check the configuration of one asset as the launcher does."""
    from ..launch.config import load_config
    from ..launch.config_check import check_config

    paths = [Path(source.name) for source in all_sources(recipe, job)]
    check_config(load_config(*paths, cli_args=[*run_overrides(recipe, job), HERE]))


def unfinished(place: Place, prompts: Path, total: int) -> tuple[int, Iterator[Job]]:
    """Return how many rows are finished, and the others; raises AnotherRow for a changed one."""
    finished: set[int] = set()
    begun: dict[int, tuple[float, bool]] = {}
    rows = place.records(read_rows(prompts))
    for row, record in tqdm(rows, "records", total, unit="asset", disable=None, delay=1):
        if record["state"] == FINISHED:
            finished.add(row.line)
        elif record["state"] == CHANGED:
            raise AnotherRow(row)
        elif "worker_seconds" in record:
            begun[row.line] = record["worker_seconds"], record.get("saves_memory", False)
    rest = (row for row in read_rows(prompts) if row.line not in finished)
    return len(finished), (job_of(row, *begun.get(row.line, (0.0, False))) for row in rest)


def require_same_farm(place: Place, recipe: Recipe, *, before_ray: bool = False) -> None:
    """Check that a folder is new, which is noted but ``before_ray``, or of the same farm."""
    ours = {
        "version": __version__,
        "configurations": [
            f"{Path(source.name).name} {hashlib.sha256(source.content).hexdigest()[:16]}"
            for source in recipe.sources
        ],
        "overrides": list(recipe.overrides),
        "device": "cpu" if recipe.cpu else "gpu",
        "cores": recipe.cores if recipe.cpu else None,
    }
    (theirs,) = place.read_json(FARM)
    if theirs is None:
        if not before_ray:
            place.write(FARM, ours)
        return
    for name, here in ours.items():
        there = theirs.get(name)
        if there != here and not (before_ray and name in OF_MACHINES):
            said = f"its {name} is {json.dumps(there)[:1000]}, here {json.dumps(here)[:1000]}"
            raise UserError(f"{place} belongs to another farm: {said}; choose another --out")
