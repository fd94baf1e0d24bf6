"""Two processes that train one cloud together stay equal through densification and pruning, and
make the steps of a single process with the same views.
"""

import subprocess
import sys
import textwrap
from pathlib import Path

import pytest
import torch

from threestudio_gaussiandreamer.core import distributed, streams
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion import sds
from threestudio_gaussiandreamer.training.data import CameraConfig, TrainCameras

SCRIPT = """
    import sys, torch
    sys.path.insert(0, {root!r})
    from threestudio_gaussiandreamer import register_parts
    from threestudio_gaussiandreamer.launch.config import load_config
    from threestudio_gaussiandreamer.host import find, pl
    from threestudio_gaussiandreamer.launch.ddp import Processes, trainer_options
    from threestudio_gaussiandreamer.training import system as module
    from tests.training import runs

    register_parts()
    pl.seed_everything(0)
    overrides = [*runs.SMALL, *runs.DENSIFY, *runs.PRUNE, "exp_root_dir={folder}"]
    overrides += ["system.guidance.mesh={mesh}", "data.batch_size=4"]
    cfg = load_config(str(runs.CONFIGS / "demo.yaml"), cli_args=overrides)
    data, system = find(cfg.data_type)(cfg.data), find(cfg.system_type)(cfg.system)
    cameras, gradients, statistics = [], [], {{}}
    step, average = system.training_step, module.average_gradients


    def recorded(batch, batch_idx):
        cameras.append(batch["azimuth"])
        step(batch, batch_idx)
        if not statistics:
            buffers = system.geometry.named_buffers()
            statistics.update((name, value.clone()) for name, value in buffers)

    def averaged(parameters):
        parameters = list(parameters)
        average(parameters)
        gradients.append(torch.cat([parameter.grad.flatten() for parameter in parameters]))


    system.training_step, module.average_gradients = recorded, averaged
    options = dict(logger=False, enable_checkpointing=False, enable_progress_bar=False)
    options |= dict(limit_val_batches=0, enable_model_summary=False)
    options |= trainer_options(Processes({ranks}, 1))
    trainer = pl.Trainer(accelerator="cpu", max_steps=7, **options)
    trainer.fit(system, datamodule=data)
    state = {{"cameras": torch.stack(cameras), "gradient": gradients[0], **system.state_dict()}}
    state |= {{f"first {{name}}": value for name, value in statistics.items()}}
    torch.save(state, f"{folder}/rank{{trainer.global_rank}}of{ranks}.pt")
"""


@pytest.fixture
def processes(monkeypatch):
    """Makes this process one of several that don't talk to each other."""

    def be(rank, size):
        monkeypatch.setattr(distributed, "is_active", lambda: True)
        monkeypatch.setattr(distributed.dist, "get_rank", lambda: rank)
        monkeypatch.setattr(distributed.dist, "get_world_size", lambda: size)

    return be


def test_a_view_has_the_same_numbers_in_whichever_process(processes):
    whole = streams.normal_per_item((4, 2), 0, "noise", 5)
    shared = distributed.draw_shared(4, lambda count: torch.arange(count))
    for rank in (0, 1):
        processes(rank, 2)
        rows = distributed.own_rows(4)
        assert rows == slice(2 * rank, 2 * rank + 2)
        first = distributed.first_item(2)
        part = streams.normal_per_item((2, 2), 0, "noise", 5, first=first)
        assert torch.equal(part, whole[rows])
        assert torch.equal(
            sds.timesteps(2, 1, 999, seed=0, step=3, first=first),
            sds.timesteps(4, 1, 999, seed=0, step=3)[rows],
        )
        drawn = distributed.draw_shared(2, lambda count: torch.arange(count))
        assert torch.equal(drawn, shared[rows])


def test_views_that_a_model_sees_together_stay_in_one_process(processes):
    processes(1, 2)
    with pytest.raises(UserError, match="in groups of 4: set data.batch_size to 8"):
        TrainCameras(CameraConfig(batch_size=4, n_view=4))
    batch = TrainCameras(CameraConfig(batch_size=8, n_view=4)).collate(0)
    assert len(batch["elevation"].unique()) == 1


def trained(folder: Path, mesh: Path, ranks: int) -> list[dict[str, torch.Tensor]]:
    """Train in so many processes; return what each has recorded."""
    script = folder / "train.py"
    values = {"root": str(Path(__file__).parents[2]), "folder": folder, "mesh": mesh}
    script.write_text(textwrap.dedent(SCRIPT.format(**values, ranks=ranks)))
    command = [sys.executable, str(script)]
    finished = subprocess.run(command, capture_output=True, text=True, timeout=900)
    assert finished.returncode == 0, finished.stderr[-3000:]
    names = [folder / f"rank{rank}of{ranks}.pt" for rank in range(ranks)]
    return [torch.load(name, weights_only=True) for name in names]


@pytest.mark.slow
def test_two_processes_make_the_steps_of_one_with_the_same_views(tmp_path):
    import trimesh

    mesh = tmp_path / "box.glb"
    trimesh.creation.box().export(mesh)
    (alone,) = trained(tmp_path, mesh, 1)
    first, second = trained(tmp_path, mesh, 2)
    cameras = torch.cat([first.pop("cameras"), second.pop("cameras")], dim=1)
    assert torch.equal(cameras, alone.pop("cameras"))
    assert all(torch.equal(first[name], second[name]) for name in first)
    # float32 sums of the views in another order
    for name, least in (("gradient", 0), ("first gradient_sum", 1e-4), ("first removal", 1e-4)):
        expected = alone.pop(name)
        assert expected.abs().max() > least
        difference = (first.pop(name) - expected).abs()
        assert difference.max() <= 1e-5 * expected.abs().max(), name
    for name in ("first gradient_count", "first contribution"):
        assert torch.equal(first.pop(name), alone.pop(name))
    assert len(first["geometry.means"]) == 130  # densified and pruned
    assert all(first[name].shape == alone[name].shape for name in first)
