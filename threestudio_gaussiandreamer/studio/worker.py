"""The process of a run of the studio: ``python -m ...studio.worker FOLDER ARGUMENTS...`` is the
launcher, which also writes ``status.json``, ``cloud.npz`` and ``picture.png`` into FOLDER. Training
is the same bit for bit, since only finished steps are read."""

import contextlib
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F

from .. import images
from ..core.command import run_command
from ..core.files import atomic_file, json_text, write_file
from ..diffusion import sds
from ..guidance.base import ScoreDistillation
from ..guidance.types import items_of
from ..host import pl
from ..launch.experiment import limit_openmp_spin, prepare
from ..launch.live_viewer import current_cloud
from ..launch.options import parse_arguments
from ..metrics import psnr
from ..training.events import rgb_panel

NOT_FATAL = contextlib.suppress(Exception)
"""What is only shown must not end a run."""
SHARES = {"cloud": 0.02, "picture": 0.03}
"""Largest shares of the time that are spent on writing them."""


class Snapshots(pl.Callback):
    """Write the status and the cloud of a training, and a picture of the score model."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.due, self.status = folder, dict.fromkeys(SHARES, 0.0), {"pictures": 0}
        self.began, self.first = 0.0, 0

    def setup(self, trainer: Any, pl_module: Any, stage: str) -> None:
        name = "starting" if stage == "fit" else "rendering"
        self.write(stage=name, folder=trainer.default_root_dir, left=None)

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self.began, self.first = time.monotonic(), trainer.global_step
        self.write_cloud(trainer, pl_module)

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, *rest: Any
    ) -> None:
        for name, write in (("picture", self.write_picture), ("cloud", self.write_cloud)):
            start = time.monotonic()
            if start >= self.due[name]:
                with NOT_FATAL:
                    write(trainer, pl_module, batch)
                self.due[name] = start + (time.monotonic() - start) / SHARES[name]

    def write_cloud(self, trainer: Any, system: Any, *rest: Any) -> None:
        cloud, step, steps = current_cloud(system), trainer.global_step, trainer.max_steps
        with NOT_FATAL, atomic_file(self.folder / "cloud.npz", durable=False) as file:
            np.savez(file, **cloud._asdict())
        each = (time.monotonic() - self.began) / max(step - self.first, 1)
        left = (steps - step) * each if step > self.first else None
        metrics = {k: float(v) for k, v in trainer.callback_metrics.items() if k in ("dB", "loss")}
        counts = {"count": len(cloud.means), "step": step, "steps": steps}
        self.write(stage="training", left=left, **counts, **metrics)

    on_train_end = write_cloud

    @torch.no_grad()
    def write_picture(self, trainer: Any, system: Any, batch: dict[str, Any]) -> None:
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
        pair = [rgb_panel(image[0].movedim(0, -1).cpu()) for image in (render, drawn)]
        images.write(self.folder / "picture.png", images.grid(pair))
        self.write(likeness=float(psnr(render, drawn)), pictures=self.status["pictures"] + 1)

    def write(self, **status: Any) -> None:
        self.status |= status
        with NOT_FATAL:
            write_file(self.folder / "status.json", json_text(self.status), durable=False)


def main() -> int:
    """Run the launcher with the arguments behind the folder; return its exit code."""
    limit_openmp_spin()
    folder, *argv = sys.argv[1:]
    own = {"callbacks": [Snapshots(Path(folder))]}
    return run_command(parse_arguments, lambda args: prepare(args, argv, **own).run(), argv)


if __name__ == "__main__":
    sys.exit(main())
