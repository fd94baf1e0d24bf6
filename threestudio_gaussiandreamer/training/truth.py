"""Ground-truth pictures of a run's views, for guidances that have them (``known_truth.py``)."""

import math
from collections.abc import Mapping
from typing import Any, Optional

from jaxtyping import Float
from torch import Tensor

from ..guidance.known_truth import truth_of
from .data import GaussianDreamerDataModule
from .renderer import SplattingRenderer


def true_views(
    guidance: Any, batch: dict[str, Any], out: Mapping[str, Any]
) -> Optional[Float[Tensor, "B H W 3"]]:
    """Render the ground truth of a batch, with the background and size of its renders ``out``; None
    if ``guidance`` has none.
    """
    truth = truth_of(guidance)
    if truth is None:
        return None
    return truth.render(batch, out["comp_rgb_bg"].detach(), size=out["comp_rgb"].shape[1:3])


def prefetch_truth(system: Any) -> None:
    """Announce all cameras of a fixed pool to the ground truth, if the run of ``system`` will use
    most of them.
    """
    truth, trainer = truth_of(system.guidance), system.trainer
    if truth is None or not isinstance(trainer.datamodule, GaussianDreamerDataModule):
        return
    steps = math.inf if trainer.max_steps < 0 else trainer.max_steps - system.global_step
    views = trainer.datamodule.views_to_prefetch(steps)
    if views is None:
        return
    ours = isinstance(system.renderer, SplattingRenderer)
    downsample = system.renderer.cfg.downsample if ours else 1
    size = views["height"] // downsample, views["width"] // downsample
    truth.prefetch(views["c2w"].to(system.device), views["fovy"].to(system.device), *size)
