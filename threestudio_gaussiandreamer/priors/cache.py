"""Cache the output of the prior in the run's folder, from which a restarted run reads it."""

import contextlib
import hashlib
import json
import sys
from collections.abc import Iterator, Mapping
from itertools import islice
from pathlib import Path
from typing import Any, Optional

import numpy as np

from .. import __version__
from ..core.errors import UserError
from ..core.files import atomic_file
from ..formats.array_files import read_arrays
from ..formats.ply import write_points
from ..gaussians.point_cloud import PointCloud
from ..host import info, run_seed
from ..meshes.side_files import consulted, stamp
from .base import points_of

MAX_FILES = 1000
"""Files of a folder that are compared; models have fewer."""


def cached_cloud(prior: Any, prompt: str, save_dir: Optional[str]) -> PointCloud:
    """Return ``prior(prompt)``, read from ``save/prior/points.npz`` if that is of the same prior,
    options, prompt and seed, and all files are as they were; ``points.ply`` beside it is for
    inspection. If ``save_dir`` is None, nothing is read or written.
    """
    if save_dir is None:
        return points_of(prior, prompt)
    path, key = Path(save_dir) / "prior" / "points.npz", cache_key(prior, prompt)
    cloud = read_cache(path, key)
    if cloud is not None:
        info(f"the prior's points come from {path}")
        return cloud
    consulted.clear()
    cloud = points_of(prior, prompt)
    path.parent.mkdir(parents=True, exist_ok=True)
    saved = cloud._asdict() | {"joints": getattr(prior, "joints", None)}  # of a posed body
    content = {name: value for name, value in saved.items() if value is not None}
    beside = np.array(json.dumps(list(consulted.items())))
    with atomic_file(path) as file:
        np.savez_compressed(file, key=np.array(key), beside=beside, **content)
    write_points(path.with_suffix(".ply"), cloud)
    return cloud


def cache_key(prior: Any, prompt: str) -> str:
    """Return a digest of what the output depends on, with the named files and the class's code."""
    options = dict(prior.cfg) if isinstance(prior.cfg, Mapping) else vars(prior.cfg)
    content = [type(prior).__module__, type(prior).__qualname__, options, prompt, run_seed()]
    content += [__version__, *_files(options), *_code(type(prior))]
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def _files(options: Any) -> Iterator[tuple[str, int, int]]:
    """Yield name, size and time of change of the files that options name, or in such folders."""
    values = options.values() if isinstance(options, dict) else options
    for value in values:
        if isinstance(value, (dict, list, tuple)):
            yield from _files(value)
        elif isinstance(value, (str, Path)) and value:
            with contextlib.suppress(OSError, ValueError, RuntimeError):  # no usable name
                path = Path(value).expanduser()
                inside = sorted(islice(path.rglob("*"), MAX_FILES)) if path.is_dir() else []
                for file in filter(Path.is_file, (path, *inside)):
                    yield file.name, file.stat().st_size, file.stat().st_mtime_ns


def _code(kind: type) -> Iterator[tuple[str, str]]:
    """Yield name and digest of the source files of a class and its bases, in packages of all."""
    modules = {base.__module__ for base in kind.__mro__}
    found = [getattr(sys.modules.get(name), "__file__", None) for name in sorted(modules)]
    for file in map(Path, filter(None, found)):
        package = (file.parent / "__init__.py").is_file()
        for source in sorted(file.parent.rglob("*.py")) if package else [file]:
            with contextlib.suppress(OSError):  # not to be read
                yield source.name, hashlib.sha256(source.read_bytes()).hexdigest()


def read_cache(path: Path, key: str) -> Optional[PointCloud]:
    """Return the cached cloud; None if missing or damaged, or if the key or the files changed."""
    names = ["key", "beside", "points", "colors"]
    try:  # a missing file is a UserError too
        data = read_arrays(path, "cache", names, ["normals", "faces"])
        beside = json.loads(str(data.pop("beside")))
    except (UserError, ValueError):
        return None
    changed = any(stamp(file) != (found and tuple(found)) for file, found in beside)
    return None if str(data.pop("key")) != key or changed else PointCloud(**data)
