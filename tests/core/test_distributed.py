"""Two processes that train one cloud together stay equal through densification, and see different
cameras.
"""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from threestudio_gaussiandreamer.core import distributed

SCRIPT = """
    import sys, torch
    sys.path.insert(0, {root!r})
    from threestudio_gaussiandreamer import register_parts
    from threestudio_gaussiandreamer.launch.config import load_config
    from threestudio_gaussiandreamer.host import find, pl
    from threestudio_gaussiandreamer.launch.ddp import ReplicatedStrategy
    from tests.training import runs

    register_parts()
    pl.seed_everything(0)
    overrides = [*runs.SMALL, *runs.DENSIFY, "exp_root_dir={folder}"]
    overrides += ["system.geometry.prior.path={mesh}"]
    cfg = load_config("{config}", cli_args=overrides)
    data, system = find(cfg.data_type)(cfg.data), find(cfg.system_type)(cfg.system)
    cameras = []
    step = system.training_step


    def recorded(batch, batch_idx):
        cameras.append(batch["azimuth"])
        return step(batch, batch_idx)

    system.training_step = recorded
    strategy = ReplicatedStrategy(process_group_backend="gloo")
    options = dict(logger=False, enable_checkpointing=False, enable_progress_bar=False)
    options |= dict(limit_val_batches=0, enable_model_summary=False)
    trainer = pl.Trainer(accelerator="cpu", devices=2, strategy=strategy, max_steps=6, **options)
    trainer.fit(system, datamodule=data)
    state = {{"cameras": torch.stack(cameras), **system.state_dict()}}
    torch.save(state, f"{folder}/rank{{trainer.global_rank}}.pt")
"""


def test_a_single_process_changes_nothing():
    parameter = torch.nn.Parameter(torch.zeros(2))
    parameter.grad = torch.ones(2)
    distributed.average_gradients([parameter])
    assert torch.equal(parameter.grad, torch.ones(2)) and distributed.rank() == 0
    assert torch.equal(distributed.all_max(torch.tensor([3.0])), torch.tensor([3.0]))


@pytest.mark.slow
def test_two_processes_keep_equal_clouds_and_use_different_cameras(tmp_path):
    import trimesh

    from tests.training import runs

    mesh = tmp_path / "box.glb"
    trimesh.creation.box().export(mesh)
    config = runs.mocked_config(tmp_path, mesh)
    script = tmp_path / "train.py"
    script.write_text(
        textwrap.dedent(
            SCRIPT.format(
                root=str(Path(__file__).parents[2]), folder=tmp_path, mesh=mesh, config=config
            )
        )
    )
    finished = subprocess.run(
        [sys.executable, str(script)], capture_output=True, text=True, timeout=300
    )
    assert finished.returncode == 0, finished.stderr[-3000:]
    first, second = (torch.load(tmp_path / f"rank{rank}.pt", weights_only=True) for rank in (0, 1))
    assert not torch.equal(first.pop("cameras"), second.pop("cameras"))
    assert len(first["geometry.means"]) > 250  # it did densify
    assert all(torch.equal(first[name], second[name]) for name in first)
