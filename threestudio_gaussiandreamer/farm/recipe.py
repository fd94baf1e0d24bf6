"""Read and check the configuration of a farm before any work: its own, and those of the rows."""

from collections.abc import Iterable, Iterator
from functools import cache
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..launch.config_source import read_yaml
from ..launch.experiment import read_source
from ..launch.options import find_config
from .assets import MANAGED, Job, Recipe, Source, run_overrides
from .ledger import FINISHED, Ledger
from .rows import Row

LOW_MEMORY = "gaussiandreamer-lowmem.yaml"
MOST_CHECKS = 500
"""Rows of one list may have different overrides; so many are checked before any work, and further
ones when it is their turn."""


@cache
def read_config(name: str) -> Source:
    """Read a YAML file by its path, or by its name as the launcher does."""
    path = find_config(name)
    return Source(str(path), read_source(path))


def make_recipe(
    configs: Iterable[str], overrides: Iterable[str], *, cpu: bool, cores: int
) -> Recipe:
    """Return what all assets have in common.

    Raises:
        UserError: a file is missing, or an override is one that the farm sets.
    """
    overrides = tuple(overrides)
    for override in overrides:
        require_free(override)
    return Recipe(tuple(map(read_config, configs)), overrides, cpu, cores)


def root_of(configs: Iterable[str]) -> str:
    """Return ``exp_root_dir`` of the configuration: the folder or URL for the farm's folder."""
    roots = [read_yaml(read_config(name).name).get("exp_root_dir") for name in configs]
    return str([root for root in ["outputs", *roots] if root][-1])


def require_free(override: str) -> None:
    """Raise UserError for an override of an option that the farm sets."""
    key = override.partition("=")[0]
    if key in MANAGED:
        raise UserError(f"{key} is set by {MANAGED[key]}: remove {override[:80]!r}")


def job_of(row: Row) -> Job:
    """Return the job of a row, with the YAML files of its column ``config``.

    Raises:
        UserError: a file is missing, or an override is one that the farm sets.
    """
    for override in row.overrides:
        require_free(override)
    return Job(row, tuple(map(read_config, row.config)))


def jobs_left(rows: Iterable[Row], ledger: Ledger) -> Iterator[Job]:
    """Yield the jobs that aren't finished."""
    for row in rows:
        if ledger.state(row) != FINISHED:
            yield job_of(row)


def check_recipe(recipe: Recipe, rows: Iterable[Row]) -> Recipe:
    """Check the configuration of each different combination of rows' ``config`` and ``overrides``.

    Returns:
        the recipe with the low-memory configuration, if that is valid with the farm's.

    Raises:
        UserError: the first error, with the line of the row.
    """
    from .. import register_parts
    from ..launch.extensions import load_extensions

    register_parts()
    load_extensions()
    first: Optional[Row] = None
    checked = set()
    for row in rows:
        first = first or row
        kind = row.config, row.overrides
        if kind not in checked and len(checked) < MOST_CHECKS:
            checked.add(kind)
            check_row(recipe, row)
    return recipe if first is None else with_low_memory(recipe, first)


def check_row(recipe: Recipe, row: Row) -> None:
    try:
        check_job(recipe, job_of(row))
    except UserError as error:
        if row.config or row.overrides:
            raise UserError(f"line {row.line} of the prompt list: {error}") from error
        raise


def check_job(recipe: Recipe, job: Job) -> Any:
    """Check the configuration of one asset as the launcher does, and return it."""
    from ..launch.config import load_config
    from ..launch.config_check import check_config

    extra = [recipe.low_memory] if job.saves_memory and recipe.low_memory else []
    paths = [Path(source.name) for source in (*recipe.sources, *job.sources, *extra)]
    # the farm's own exp_root_dir may be a URL, which a single run refuses
    cfg = load_config(*paths, cli_args=[*run_overrides(recipe, job), "exp_root_dir=outputs"])
    check_config(cfg)
    return cfg


def with_low_memory(recipe: Recipe, row: Row) -> Recipe:
    """Return the recipe with the low-memory configuration, if it is valid with the row's."""
    try:
        saving = recipe._replace(low_memory=read_config(LOW_MEMORY))
        check_job(saving, job_of(row)._replace(saves_memory=True))
    except UserError:
        return recipe
    return saving
