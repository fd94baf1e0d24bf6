"""Show the cloud in a browser while it trains: ``viewer.enabled=true viewer.port=8080``.

============  =====================================================================================
option        meaning
============  =====================================================================================
enabled       serve the cloud with viser (extra ``[viewer]``)
host          address to listen on; 127.0.0.1 accepts this machine and SSH tunnels only
port          port of the web page and its WebSocket
keep_serving  keep the server running after the training, until Ctrl-C
============  =====================================================================================

The training is the same bit for bit with and without the viewer, which only reads the cloud."""

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Optional

import torch

from .. import images
from ..core.options import in_range
from ..formats.gaussian_files import StoredCloud
from ..gaussians.gaussians import Gaussians, drawable
from ..host import info, pl
from ..training.events import score_panels
from ..view.live import Controls, LiveView
from ..view.render import first_pose

SHARE_OF_TIME = 0.02
"""Largest share of the training's time that its thread spends on updates."""
SECONDS_BETWEEN = 1.0
"""Shortest time between two updates, seconds."""
POLL = 0.05
"""Seconds between two checks of the buttons while the training is paused."""


@dataclass
class ViewerConfig:
    enabled: bool = False
    host: str = "127.0.0.1"
    port: int = field(default=8080, metadata=in_range(1, 65535))
    keep_serving: bool = True

    REMOVED = {"updates_per_second": (1.0, "the cloud is updated once a second")}


class LiveViewer(pl.Callback):
    """Update a :class:`LiveView` from the training, and act on its buttons; ``stopping`` says
    whether a signal has asked the training to stop, which also ends a pause.
    """

    def __init__(self, view: LiveView, stopping: Callable[[], bool]) -> None:
        self.view, self.stopping = view, stopping
        self.controls: Optional[Controls] = None
        self._due = 0.0

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self.view.look_from_front(first_pose(StoredCloud(current_cloud(pl_module))))
        self._show(trainer, pl_module)
        self.controls = Controls(self.view)
        info(f"the viewer is at {self.view.address}")

    def on_train_batch_start(self, trainer: Any, pl_module: Any, batch: Any, *rest: Any) -> None:
        while not (self.controls.may_go_on() or self.stopping()):
            self._update(trainer, pl_module, batch, cameras=False)
            time.sleep(POLL)

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, *rest: Any
    ) -> None:
        self._update(trainer, pl_module, batch)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self._show(trainer, pl_module)
        self.controls.remove()

    def _show(self, trainer: Any, system: Any) -> None:
        cloud, decibels = current_cloud(system), trainer.callback_metrics.get("dB")
        quality = "" if decibels is None else f", {float(decibels):.1f} dB"
        step = f"step {trainer.global_step}, {len(cloud.means):,} Gaussians{quality}"
        self.view.show(cloud, step)

    def _update(self, trainer: Any, system: Any, batch: Any, cameras: bool = True) -> None:
        """Show what is asked for or due: the score model's picture, the cloud, its cameras."""
        if self.controls.picture.is_set():
            self.controls.picture.clear()
            self.controls.show_picture(score_picture(system, batch))
        start = time.monotonic()
        if start < self._due or not self.view.watched:
            return
        self._show(trainer, system)
        if cameras and self.controls.cameras.value:
            pose, fovy = (batch[name].detach().cpu().numpy() for name in ("c2w", "fovy"))
            self.view.show_cameras(pose, fovy, batch["width"] / batch["height"])
        spent = time.monotonic() - start
        self._due = start + max(SECONDS_BETWEEN, spent / SHARE_OF_TIME)


def current_cloud(system: Any) -> Gaussians:
    """Return the finite Gaussians of a system as arrays."""
    return drawable(Gaussians.of(system.geometry).arrays(), "viewer")


@torch.no_grad()
def score_picture(system: Any, batch: dict[str, Any]) -> Any:
    """Draw what the score model makes of the first training view, uint8 (H, W, 3)."""
    system.eval()
    try:
        out = system(batch)
        evaluated = system.guide(out, batch, guidance_eval=True)["eval"]
    finally:
        system.train()
    return images.grid(score_panels(evaluated, out["comp_rgb"].shape[1:3]))
