"""Clouds of the evaluation tests."""

import json

import numpy as np
import pytest

from tests.helpers.painted_ball import opaque_cloud
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, write_cloud


def blob(center=(0.0, 0.0, 0.0), color=(0.9, 0.1, 0.1), count=40, seed=0):
    """Return a few opaque Gaussians around ``center``."""
    rng = np.random.default_rng(seed)
    means = np.array(center) + 0.3 * rng.normal(size=(count, 3))
    return opaque_cloud(means, np.tile(np.array(color), (count, 1)), 0.15, 0.98)


def save(path, arrays):
    path.parent.mkdir(parents=True, exist_ok=True)
    write_cloud(str(path), StoredCloud(arrays))
    return path


def run_of(folder, system, seed=0):
    """Write a run with this section of its configuration; return its file of Gaussians."""
    (folder / "configs").mkdir(parents=True)
    (folder / "configs/parsed.yaml").write_text(json.dumps({"system": system}))
    return save(folder / "save/it5-export/gaussians.ply", blob(seed=seed))


@pytest.fixture
def plys(tmp_path):
    return [str(save(tmp_path / f"{i}.ply", blob(seed=i))) for i in range(2)]
