"""Cache the output of the prior in the run's folder, from which a restarted run reads it."""

import hashlib
import json
from pathlib import Path
from typing import Any, Optional

import numpy as np
from omegaconf import OmegaConf

from ..core.errors import UserError
from ..core.files import atomic_file
from ..formats.array_files import read_arrays
from ..formats.ply import write_points
from ..gaussians.point_cloud import PointCloud
from ..host import info, run_seed, warn
from .base import points_of
from .turntable import save_turntable


def cached_cloud(prior: Any, prompt: str, save_dir: Optional[str]) -> PointCloud:
    """Return ``prior(prompt)``, read from ``save/prior/points.npz`` if that file is of the same
    prior, options, prompt and seed.

    ``points.ply`` and ``turntable.gif`` are written beside it, for inspection. If ``save_dir`` is
    None, nothing is read or written."""
    if save_dir is None:
        return points_of(prior, prompt)
    path, key = Path(save_dir) / "prior" / "points.npz", cache_key(prior, prompt)
    cloud = read_cache(path, key)
    if cloud is not None:
        info(f"the prior's points come from {path}")
        return cloud
    cloud = points_of(prior, prompt)
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_file(path) as file:
        np.savez_compressed(
            file,
            key=np.array(key),
            **{name: value for name, value in cloud._asdict().items() if value is not None},
        )
    write_points(path.with_suffix(".ply"), cloud)
    try:
        save_turntable(cloud, path.with_name("turntable.gif"))
    except (UserError, OSError) as error:  # it is only for inspection
        warn(str(error))
    return cloud


def cache_key(prior: Any, prompt: str) -> str:
    """Return a digest of everything that the prior's output depends on."""
    options = (
        OmegaConf.to_container(prior.cfg) if OmegaConf.is_config(prior.cfg) else vars(prior.cfg)
    )
    content = [type(prior).__module__, type(prior).__qualname__, options, prompt, run_seed()]
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()


def read_cache(path: Path, key: str) -> Optional[PointCloud]:
    """Return the cached cloud; None if there is none, its key differs, or the file is damaged."""
    if not path.is_file():
        return None
    try:
        data = read_arrays(path, "cache", ["key", "points", "colors"], ["normals", "faces"])
    except UserError:
        return None
    return None if str(data.pop("key")) != key else PointCloud(**data)
