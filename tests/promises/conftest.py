"""The gallery: one tiny run, made once, and the run of an earlier version, which all tests read."""

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from .commands import DATA, SMOKE, launch

os.environ.setdefault("HF_HUB_OFFLINE", "1")


@pytest.fixture(autouse=True)
def own_folder(tmp_path) -> Iterator[None]:
    """Work in a folder of the test's own."""
    before = Path.cwd()
    os.chdir(tmp_path)
    yield
    os.chdir(before)


@pytest.fixture(scope="session")
def trained(tmp_path_factory) -> Path:
    """Return the folder of a finished run of ``smoke.yaml``, to be read only."""
    root = tmp_path_factory.mktemp("gallery")
    places = [f"exp_root_dir={root}", "use_timestamp=false", "tag=gallery"]
    kept = ["checkpoint.save_top_k=-1", "checkpoint.every_n_train_steps=4"]
    result = launch(*SMOKE, *places, *kept, "trainer.val_check_interval=4")
    assert result.code == 0, result.err
    return root / "smoke" / "gallery"


@pytest.fixture
def earlier(tmp_path) -> Path:
    """Return a copy of a run that an earlier version has left: ``configs/parsed.yaml`` and
    ``ckpts/last.ckpt`` of 48 Gaussians of degree 1, at step 8.
    """
    return Path(shutil.copytree(DATA / "run", tmp_path / "old"))
