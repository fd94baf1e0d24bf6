"""A system of a few parameters with all hooks of a real one, also loadable as an extension."""

import os
import signal
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import nn
from torch.utils.data import DataLoader, IterableDataset

from threestudio_gaussiandreamer import host
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.streams import generator
from threestudio_gaussiandreamer.host import BaseGeometry, BaseLift3DSystem, BaseObject, register


@register("tiny-prior")
class TinyPrior(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        count: int = 4

        @staticmethod
        def check(cfg: Any) -> None:
            if cfg.count < 1:
                raise UserError(f"count: expected at least 1, got {cfg.count}")

    cfg: Config


@register("tiny-geometry")
class TinyGeometry(BaseGeometry):
    @dataclass
    class Config(BaseGeometry.Config):
        size: int = 3
        prior_type: str = "tiny-prior"
        prior: dict = field(default_factory=dict)

    cfg: Config

    def configure(self) -> None:
        self.count = host.find(self.cfg.prior_type)(self.cfg.prior).cfg.count
        self.means = nn.Parameter(torch.zeros(self.cfg.size))
        self.updates: list[int] = []

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        self.updates.append(global_step)


@register("tiny-renderer")
class TinyRenderer(host.Rasterizer):
    def forward(self, **batch: Any) -> dict[str, Any]:
        return {"comp_rgb": self.geometry.means.sigmoid().expand(1, 4, 4, 3)}


@register("tiny-prompts")
class TinyPrompts(BaseObject):
    @dataclass
    class Config(BaseObject.Config):
        prompt: str = ""

    cfg: Config


@register("tiny-exporter")
class TinyExporter(host.Exporter):
    def __call__(self) -> list[host.ExporterOutput]:
        return [host.ExporterOutput("means", "data", {"data": {"means": self.geometry.means}})]


@register("tiny-system")
class TinySystem(BaseLift3DSystem):
    @dataclass
    class Config(BaseLift3DSystem.Config):
        fail_in: str = ""  # configure, on_fit_start or "step <number>"
        signal_at: int = -1
        signal_name: str = "SIGINT"

    cfg: Config

    def configure(self) -> None:
        super().configure()
        self.automatic_optimization = False
        self._fail("configure")

    def _fail(self, where: str) -> None:
        if self.cfg.fail_in == where:
            raise UserError(f"failed in {where}, as asked")

    def on_fit_start(self) -> None:
        super().on_fit_start()
        self._fail("on_fit_start")

    def configure_optimizers(self) -> torch.optim.Optimizer:
        return torch.optim.Adam([{"params": [self.geometry.means], "name": "means"}], lr=0.1)

    def training_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        step = self.global_step
        self._fail(f"step {step}")
        if step == self.cfg.signal_at:
            os.kill(os.getpid(), getattr(signal, self.cfg.signal_name))
        target = torch.randn(3, generator=generator(host.run_seed(), "target", step))
        weight = self.C(self.cfg.loss.get("lambda_fit", 1.0))
        loss = weight * (self.geometry.means - target).square().sum()
        optimizer = self.optimizers()
        optimizer.zero_grad()
        self.manual_backward(loss)
        optimizer.step()
        self.log("loss", loss.detach(), prog_bar=True)

    def validation_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self._save_picture_of(f"it{self.true_global_step}-{int(batch['index'])}.png")

    def test_step(self, batch: dict[str, Any], batch_idx: int) -> None:
        self._save_picture_of(f"it{self.true_global_step}-test/{int(batch['index'])}.png")

    def on_test_epoch_end(self) -> None:
        folder = f"it{self.true_global_step}-test"
        self.save_img_sequence(folder, folder, r"(\d+)\.png")

    def summary(self) -> str:
        return f"results are in {self.get_save_dir()}"

    def _save_picture_of(self, name: str) -> None:
        self.save_image_grid(name, [{"type": "rgb", "img": self.renderer()["comp_rgb"][0]}])


class Steps(IterableDataset, host.Updateable):
    def __iter__(self):
        while True:
            yield {"index": torch.tensor([0])}


@register("tiny-data")
class TinyData(host.pl.LightningDataModule):
    @dataclass
    class Config:
        views: int = 2

    def __init__(self, cfg: Any = None) -> None:
        super().__init__()
        self.views = (cfg or {}).get("views", 2)

    def train_dataloader(self) -> DataLoader:
        return DataLoader(Steps(), batch_size=None)

    def val_dataloader(self) -> DataLoader:
        return DataLoader([{"index": i} for i in range(self.views)], batch_size=1)

    test_dataloader = predict_dataloader = val_dataloader


CONFIG = """
name: tiny
tag: "${rmspace:${system.prompt_processor.prompt},_}"
seed: 3
data_type: tiny-data
data: {views: 2}
system_type: tiny-system
system:
  geometry_type: tiny-geometry
  geometry: {size: 3, prior_type: tiny-prior, prior: {count: 2}}
  renderer_type: tiny-renderer
  prompt_processor_type: tiny-prompts
  prompt_processor:
    prompt: a red ball
  exporter_type: tiny-exporter
  loss: {lambda_fit: 1.0}
trainer:
  max_steps: 6
  log_every_n_steps: 2
  num_sanity_val_steps: 0
  val_check_interval: 3
  enable_progress_bar: false
checkpoint:
  save_last: true
  save_top_k: -1
  every_n_train_steps: ${trainer.max_steps}
"""
