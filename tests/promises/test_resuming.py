"""A resumed run equals an uninterrupted one bit for bit, also that of an earlier version."""

import os
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import torch

from .commands import DATA, ROOT, SMOKE, command, launch, refused


def differences(one, other, where: str = "") -> list[str]:
    """Return where two checkpoints differ."""
    if isinstance(one, torch.Tensor):
        same = one.dtype == other.dtype and torch.equal(one, other)
        return [] if same else [where]
    if isinstance(one, (dict, list, tuple)) and len(one) == len(other):
        keys = one if isinstance(one, dict) else range(len(one))
        return [d for key in keys for d in differences(one[key], other[key], f"{where}.{key}")]
    return [] if one == other else [where]


def load(path: Path) -> dict:
    return torch.load(path, weights_only=True)


TRAINED = ("state_dict", "optimizer_states", "global_step", "epoch")


def test_a_resumed_run_is_the_same_bit_for_bit(trained):
    middle = trained / "ckpts/epoch=0-step=4.ckpt"
    result = launch(*SMOKE, f"resume={middle}", "use_timestamp=false", "tag=resumed")
    assert result.code == 0, result.err
    resumed = Path("outputs/smoke/resumed")
    one, other = (load(folder / "ckpts/last.ckpt") for folder in (trained, resumed))
    assert one["global_step"] == 8 and load(middle)["global_step"] == 4
    assert [d for key in TRAINED for d in differences(one[key], other[key], key)] == []
    for name in ("gaussians.ply", "gaussians.spz"):
        same = [(run / "save/it8-export" / name).read_bytes() for run in (trained, resumed)]
        assert same[0] == same[1]


def test_the_automatic_count_is_the_same_after_resuming_between_its_rounds():
    rounds = [f"system.geometry.prune.{x}" for x in ("start=2", "stop=8", "every=2", "keep=0.8")]
    auto = [*SMOKE, "system.geometry.budget=auto", "system.geometry.prune.gain=5", *rounds]
    auto += ["system.geometry.densify.enabled=false", "use_timestamp=false"]
    kept = ["checkpoint.save_top_k=-1", "checkpoint.every_n_train_steps=3"]
    assert launch(*auto, *kept, "tag=whole").code == 0
    ckpts = Path("outputs/smoke/whole/ckpts")
    assert launch(*auto, f"resume={ckpts}/epoch=0-step=3.ckpt", "tag=again").code == 0
    states = [load(ckpts / "epoch=0-step=3.ckpt"), load(ckpts / "last.ckpt")]
    states.append(load(Path("outputs/smoke/again/ckpts/last.ckpt")))
    middle, end = (len(state["state_dict"]["geometry.means"]) for state in states[:2])
    assert middle > end  # rounds before and after it have dropped some
    assert [d for key in TRAINED for d in differences(states[1][key], states[2][key], key)] == []


def test_the_seed_decides(trained):
    """The same seed repeats a run, also from its ``parsed.yaml``; another one doesn't."""
    found = []
    for seed in (0, 1):
        parsed = trained / "configs/parsed.yaml"
        where = [f"seed={seed}", f"tag={seed}", "exp_root_dir=outputs"]
        assert launch("--config", parsed, "--train", *where).code == 0
        found.append(load(Path(f"outputs/smoke/{seed}/ckpts/last.ckpt"))["state_dict"])
    first = load(trained / "ckpts/last.ckpt")["state_dict"]
    assert differences(first, found[0]) == [] and differences(first, found[1])


def test_the_run_of_an_earlier_version_goes_on(earlier):
    """In its folder, which was copied elsewhere, by its own ``parsed.yaml``."""
    again = ["resume=auto", "trainer.max_steps=10"]
    result = launch("--config", earlier / "configs/parsed.yaml", "--train", *again)
    assert result.code == 0, result.err
    last = load(earlier / "ckpts/last.ckpt")
    assert last["global_step"] == 10
    assert last["state_dict"]["geometry.means"].shape == (48, 3)


DEMO = [
    *("tag=old", "use_timestamp=false", "data.width=32", "data.height=32", "data.eval_width=32"),
    *("data.eval_height=32", "data.n_test_views=2", "data.train_views=4"),
    *("system.geometry.budget=70", "system.evaluation.size=32", "system.evaluation.views=2"),
    *("trainer.val_check_interval=10", "trainer.max_steps=10", "trainer.enable_progress_bar=false"),
]
OLDER = DATA.parents[1] / "data/earlier"


@pytest.mark.parametrize("stage", ["--train", "--export"])
def test_a_checkpoint_of_the_first_layout_goes_on(stage):
    """Of ``demo.yaml``, with the options given again."""
    shutil.copyfile(OLDER / "last.ckpt", "earlier.ckpt")
    result = launch("--config", "demo.yaml", stage, "resume=earlier.ckpt", *DEMO)
    assert result.code == 0, result.err
    (ply,) = Path("outputs/demo/old/save").glob("*-export/gaussians.ply")
    assert b"element vertex 70\n" in ply.read_bytes()
    if stage == "--train":
        assert load(Path("outputs/demo/old/ckpts/last.ckpt"))["global_step"] == 10


@pytest.mark.parametrize("name", ["gaussians.ply", "gaussians.spz"])
def test_a_file_of_the_first_layout_is_pruned(name):
    options = ["--count", "65", "--size", "32", "--steps", "2"]
    assert command("prune", OLDER / name, "out.ply", *options).code == 0
    assert b"element vertex 65\n" in Path("out.ply").read_bytes()


@pytest.mark.slow
def test_a_folder_in_use_ctrl_c_and_the_command_that_resumes(tmp_path):
    """In a process of its own, which trains until it is stopped."""
    where = [*SMOKE, "use_timestamp=false", "tag=t"]
    endless = ["--gpu", "cpu", "trainer.max_steps=1000000", "trainer.val_check_interval=1000000"]
    started = [sys.executable, str(ROOT / "launch.py"), *where, *endless]
    streams = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    process = subprocess.Popen(started, env=environment, **streams)
    try:
        deadline = time.monotonic() + 300
        while not list(Path("outputs").glob("smoke/t/csv_logs/version_0/metrics.csv")):
            assert process.poll() is None and time.monotonic() < deadline, process.communicate()
            time.sleep(0.1)
        in_use = "another run is training in outputs/smoke/t"
        refused(launch(*where), in_use, f"process {process.pid} ")
        process.send_signal(signal.SIGINT)
        out, err = process.communicate(timeout=300)
    finally:
        process.kill()
    assert process.returncode == 130 and "Traceback" not in err
    step = int(re.search(r"stopped at step (\d+)", out)[1])
    words = shlex.split(re.search(r"to resume: (.*)", out)[1])
    resumed = launch(*words[2:], f"trainer.max_steps={step + 2}")
    assert resumed.code == 0, resumed.err
    assert load(tmp_path / "outputs/smoke/t/ckpts/last.ckpt")["global_step"] == step + 2
