"""configs/polish.yaml: a cloud of another program comes in upright, and is merged, pruned to the
budget and refined."""

from pathlib import Path

import numpy as np
import pytest

from tests.training.runs import CONFIGS, SMALL
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.formats.producers import GAUSSIANS, producer_axes, to_y_up
from threestudio_gaussiandreamer.gaussians.axes import VIEWER_UP, rotate, rotation_between
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.launch.experiment import main

COUNT, BUDGET, STEPS = 300, 80, 4
SIZES = [word for word in SMALL if "geometry" not in word]


@pytest.fixture
def dense_file(tmp_path):
    """Write a tall cloud in TripoSplat's axes, red in front, blue behind, every Gaussian twice."""
    rng = np.random.default_rng(0)
    means = np.float32(rng.normal(size=(COUNT, 3)) * [0.15, 0.15, 0.5])
    sh = np.zeros((COUNT, 1, 3), np.float32)
    sh[:, 0, 0], sh[:, 0, 2] = np.sign(means[:, 0]), -np.sign(means[:, 0])
    cloud = Gaussians(
        means=means,
        quats=np.tile(np.float32([1, 0, 0, 0]), (COUNT, 1)),
        log_scales=np.full((COUNT, 3), np.log(0.05), np.float32),
        logit_opacities=np.full(COUNT, 2, np.float32),
        sh=sh,
    ).map(lambda values: np.concatenate([values, values]))
    to_file = to_y_up(producer_axes("triposplat", GAUSSIANS)).T @ rotation_between("z", "y")
    path = tmp_path / "dense.ply"
    write_cloud(str(path), StoredCloud(rotate(cloud, to_file), VIEWER_UP))
    return path


@pytest.mark.slow
def test_a_dense_cloud_ends_upright_with_the_budget(dense_file, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    configs = [
        word for name in ("demo", "polish") for word in ("--config", f"{CONFIGS / name}.yaml")
    ]
    options = [
        f"system.geometry.prior.path={dense_file}",
        f"system.geometry.budget={BUDGET}",
        "system.geometry.prune.start=1",
        "system.geometry.prune.stop=4",
        "system.geometry.prune.every=1",
        f"trainer.max_steps={STEPS}",
    ]
    assert main([*configs, "--train", "--gpu", "cpu", *SIZES, *options]) == 0
    cloud = read_cloud(str(Path(f"outputs/demo/t/save/it{STEPS}-export/gaussians.ply")))
    found = cloud.in_axes("z").gaussians
    assert len(found.means) == BUDGET
    spread = np.ptp(found.means, axis=0)
    assert spread.argmax() == 2 and spread[2] == pytest.approx(2, abs=0.4)  # scaled and upright
    red = found.sh[:, 0, 0] > found.sh[:, 0, 2]
    assert found.means[red, 0].mean() > 0.05 > -0.05 > found.means[~red, 0].mean()  # the front
