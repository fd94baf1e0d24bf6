"""Files written by an earlier layout of the package can be read, resumed, exported and pruned."""

import shutil
from pathlib import Path

import pytest
import torch

from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.prune import main as prune

ROOT = Path(__file__).parents[2]
EARLIER = ROOT / "tests/data/earlier"
OPTIONS = [
    "tag=old",
    "use_timestamp=false",
    "data.width=32",
    "data.height=32",
    "data.eval_width=32",
    "data.eval_height=32",
    "data.n_test_views=2",
    "data.train_views=4",
    "system.geometry.budget=70",
    "system.evaluation.size=32",
    "system.evaluation.views=2",
    "trainer.val_check_interval=10",
    "trainer.max_steps=10",
    "trainer.enable_progress_bar=false",
]


def launch(folder: Path, stage: str) -> int:
    checkpoint = folder / "earlier.ckpt"
    shutil.copyfile(EARLIER / "last.ckpt", checkpoint)
    places = [f"exp_root_dir={folder}", f"resume={checkpoint}"]
    config = str(ROOT / "configs/demo.yaml")
    return main(["--config", config, stage, "--gpu", "cpu", *OPTIONS, *places])


def test_a_checkpoint_resumes(tmp_path):
    assert launch(tmp_path, "--train") == 0
    last = torch.load(tmp_path / "demo/old/ckpts/last.ckpt", weights_only=True)
    assert last["global_step"] == 10 and last["state_dict"]["geometry.means"].shape == (70, 3)


def test_a_checkpoint_is_exported(tmp_path):
    assert launch(tmp_path, "--export") == 0
    (ply,) = tmp_path.glob("demo/old/save/*-export/gaussians.ply")
    assert b"element vertex 70\n" in ply.read_bytes()


@pytest.mark.parametrize("name", ["gaussians.ply", "gaussians.spz"])
def test_a_cloud_is_pruned(tmp_path, name):
    out = tmp_path / "out.ply"
    assert (
        prune([str(EARLIER / name), str(out), "--count", "65", "--size", "32", "--steps", "2"]) == 0
    )
    assert b"element vertex 65\n" in out.read_bytes()
