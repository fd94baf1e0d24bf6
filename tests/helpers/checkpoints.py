"""A complete checkpoint of a small run, as Lightning writes it, made without a run."""

from typing import Any

import lightning.pytorch as pl
import torch

from threestudio_gaussiandreamer.training.geometry import GaussianCloud

CALLBACK = (
    "ModelCheckpoint{'monitor': None, 'mode': 'min', 'every_n_train_steps': 3, 'every_n_epochs': "
    "0, 'train_time_interval': None}"
)


def whole_checkpoint(count: int = 10, steps: int = 3) -> dict[str, Any]:
    """Return what ``torch.load`` returns for a run with ``count`` Gaussians after
    ``steps`` steps.
    """
    geometry, optimizer = trained_cloud(count, steps)
    state = {f"geometry.{key}": value for key, value in geometry.state_dict().items()}
    return {
        "epoch": 0,
        "global_step": steps,
        "pytorch-lightning_version": pl.__version__,
        "state_dict": state | {"renderer.bbox": torch.zeros(2, 3)},
        "loops": {"fit_loop": fit_loop(steps)},
        "callbacks": {CALLBACK: {"best_model_path": "", "dirpath": ".", "best_k_models": {}}},
        "optimizer_states": [optimizer.state_dict()],
        "lr_schedulers": [],
        "guidance": {},
    }


def trained_cloud(count: int, steps: int) -> tuple[GaussianCloud, torch.optim.Optimizer]:
    """Return a random cloud, and an optimiser that has stepped."""
    generator = torch.Generator().manual_seed(0)
    geometry = GaussianCloud({})
    shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "logit_opacities": ()}
    sh = torch.rand(count, 1, 3, generator=generator).numpy()
    arrays = {
        name: torch.randn(count, *shape, generator=generator).numpy()
        for name, shape in shapes.items()
    }
    geometry.set_arrays(sh=sh, **arrays)
    optimizer = torch.optim.Adam(geometry.parameter_groups(), lr=1e-3)
    for _ in range(steps):
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.ones_like(parameter)
        optimizer.step()
    return geometry, optimizer


def fit_loop(steps: int) -> dict[str, Any]:
    """Return the state of Lightning's training loop after so many steps of manual optimisation."""
    trainer = pl.Trainer(accelerator="cpu", logger=False, enable_checkpointing=False)
    epoch = trainer.fit_loop.epoch_loop
    progress = epoch.manual_optimization.optim_step_progress
    for count in (progress.total, progress.current):
        count.ready = count.completed = steps
    epoch.batch_progress.total.ready = epoch.batch_progress.current.ready = steps
    return trainer.fit_loop.state_dict()
