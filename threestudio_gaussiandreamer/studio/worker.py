"""The process of one run of the studio: ``python -m threestudio_gaussiandreamer.studio.worker
FOLDER ARGUMENTS...`` is the launcher with these arguments, and writes into FOLDER what the studio
shows: ``status.json``, ``cloud.npz`` and ``picture.png``, each replaced atomically. The training is
the same bit for bit, since only finished steps are read."""

import argparse
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from PIL import Image

from ..core import images
from ..core.command import run_command
from ..core.files import atomic_file, json_text
from ..diffusion import sds
from ..guidance.base import ScoreDistillation
from ..guidance.types import items_of
from ..host import pl
from ..launch.experiment import limit_openmp_spin, prepare
from ..launch.live_viewer import current_cloud
from ..launch.options import parse_arguments
from ..metrics import psnr
from ..training.events import rgb_panel

SHARES = {"cloud": 0.02, "picture": 0.03}
"""Largest shares of the time that are spent on writing them."""


class Snapshots(pl.Callback):
    """Write the status and the cloud of a training, and a picture of the score model."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.due = folder, dict.fromkeys(SHARES, 0.0)
        self.began, self.first, self.status = 0.0, 0, {}

    def setup(self, trainer: Any, pl_module: Any, stage: str) -> None:
        self.write(
            stage="starting" if stage == "fit" else "rendering", folder=trainer.default_root_dir
        )

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self.began, self.first = time.monotonic(), trainer.global_step
        self.write_cloud(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, *rest: Any
    ) -> None:
        self.if_due("picture", lambda: self.write_picture(pl_module, batch))
        self.if_due("cloud", lambda: self.write_cloud(trainer, pl_module))

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self.write_cloud(trainer, pl_module)

    def on_test_batch_end(self, trainer: Any, pl_module: Any, *rest: Any) -> None:
        self.if_due("cloud", lambda: self.write(stage="rendering", left=None))

    def if_due(self, name: str, write: Callable[[], None]) -> None:
        start = time.monotonic()
        if start >= self.due[name]:
            write()
            self.due[name] = start + (time.monotonic() - start) / SHARES[name]

    def write_cloud(self, trainer: Any, system: Any) -> None:
        cloud, step = current_cloud(system), trainer.global_step
        with atomic_file(self.folder / "cloud.npz", durable=False) as file:
            np.savez(file, **cloud._asdict())
        done, steps = step - self.first, trainer.max_steps
        left = (steps - step) * (time.monotonic() - self.began) / done if done else None
        quality = {k: float(v) for k, v in trainer.callback_metrics.items() if k in ("dB", "loss")}
        count = {"count": len(cloud.means), "step": step, "steps": steps, "left": left}
        self.write(stage="training", **count, **quality)

    @torch.no_grad()
    def write_picture(self, system: Any, batch: dict[str, Any]) -> None:
        """Draw the first view of a step beside what the score model makes of it in one step."""
        guidance = system.guidance
        if not isinstance(guidance, ScoreDistillation) or getattr(guidance.cfg, "n_view", 1) > 1:
            return
        batch = items_of(batch, len(batch["c2w"]), slice(1))
        system.eval()
        try:
            out = system(batch)
        finally:
            system.train()
        batch |= {"comp_rgb_bg": out["comp_rgb_bg"]}
        render = out["comp_rgb"].float().movedim(-1, 1).contiguous()
        latents = guidance.encode(render, **batch).float()
        t, abar, _, z = guidance.add_noise(latents)
        condition = guidance.condition(system.prompt_utils, **batch)
        guided = guidance.predict_noise(z, t, condition)
        drawn = guidance.decode(sds.predict_x0(z, guided, abar).float()).float().clamp(0, 1)
        drawn = F.interpolate(drawn, render.shape[-2:], mode="bilinear", align_corners=False)
        self.status["likeness"] = float(psnr(render, drawn))
        self.status["pictures"] = self.status.get("pictures", 0) + 1
        pair = [rgb_panel(image[0].movedim(0, -1)) for image in (render, drawn)]
        with atomic_file(self.folder / "picture.png", durable=False) as file:
            Image.fromarray(images.grid(pair)).save(file, "png")

    def write(self, **status: Any) -> None:
        self.status |= status
        with atomic_file(self.folder / "status.json", durable=False) as file:
            file.write(json_text(self.status).encode())


def main() -> int:
    """Run the launcher with the arguments behind the folder; return its exit code."""
    limit_openmp_spin()
    folder, *argv = sys.argv[1:]

    def run(args: argparse.Namespace) -> int:
        return prepare(args, argv, callbacks=[Snapshots(Path(folder))]).run()

    return run_command(parse_arguments, run, argv)


if __name__ == "__main__":
    sys.exit(main())
