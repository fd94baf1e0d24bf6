"""Runs of a few steps: against the painted box, or with a mock guidance (to be copied)."""

from dataclasses import dataclass
from pathlib import Path

import torch
import yaml

from threestudio_gaussiandreamer.host import BaseObject, register
from threestudio_gaussiandreamer.launch.experiment import main

CONFIGS = Path(__file__).parents[2] / "configs"
SMALL = [
    "data.width=24", "data.height=24", "data.eval_width=32", "data.eval_height=32",
    "data.n_test_views=3", "data.train_views=12", "system.geometry.prior.num_points=150",
    "system.geometry.prior.color_smoothing=0", "system.geometry.grow.num_candidates=20000",
    "system.geometry.grow.radius=0.05", "system.geometry.grow.max_points=50",
    "system.evaluation.size=24", "system.evaluation.views=2", "trainer.enable_progress_bar=false",
    "trainer.log_every_n_steps=1", "use_timestamp=false", "tag=t", "system.geometry.budget=null",
]  # fmt: skip

DENSIFY = [
    f"system.geometry.densify.{option}"
    for option in "enabled=true start=2 stop=8 every=2 grad_threshold=1e-4 min_opacity=0.01".split()
]
PRUNE = [
    "system.geometry.budget=130",
    *(f"system.geometry.prune.{option}" for option in ("start=3", "stop=8", "every=3")),
]


@dataclass
class _Config(BaseObject.Config):
    color: tuple = (0.9, 0.2, 0.1)


@register("test-mock-guidance")
class MockGuidance(BaseObject):
    """threestudio's interface: pulls every render towards one colour."""

    Config = _Config

    def __call__(self, rgb, prompt_utils, elevation, azimuth, camera_distances, **kwargs):
        target = torch.tensor(list(self.cfg.color)).expand_as(rgb)
        loss = 0.5 * ((rgb - target) ** 2).sum() / len(rgb)
        norm = (rgb - target).norm().detach()
        return {"loss_sds": loss, "grad_norm": norm, "min_step": 20, "max_step": 980}


def length(count):
    return f"trainer.max_steps={count}", f"trainer.val_check_interval={count}"


def launch(folder, mesh, *options, stage="--train"):
    overrides = [f"exp_root_dir={folder}", f"system.guidance.mesh={mesh}", *SMALL, *options]
    return main(["--config", str(CONFIGS / "demo.yaml"), stage, "--gpu", "cpu", *overrides])


def run_folder(folder):
    return Path(folder) / "demo" / "t"


def cloud_of(path):
    return torch.load(path, weights_only=True, map_location="cpu")["state_dict"]


def mocked_config(folder, mesh, **system):
    """Return the demo's YAML with the mock as its guidance."""
    cfg = yaml.safe_load((CONFIGS / "demo.yaml").read_text())
    cfg["system"] |= {"guidance_type": "test-mock-guidance", "guidance": {}, **system}
    cfg["system"]["geometry"]["prior"]["path"] = str(mesh)
    path = folder / "mocked.yaml"
    path.write_text(yaml.safe_dump(cfg))
    return path
