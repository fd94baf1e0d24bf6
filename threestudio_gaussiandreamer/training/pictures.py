"""Rows of validation pictures, in the format of the host's ``save_image_grid``, and ground-truth
pictures of a run's views, for guidances that have them (``known_truth.py``).
"""

import math
from collections.abc import Mapping
from typing import Any, Optional

import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..guidance.base import ScoreDistillation
from ..guidance.known_truth import truth_of
from .data import GaussianDreamerDataModule
from .events import log_picture
from .renderer import SplattingRenderer

Panel = dict[str, Any]
SCORE_PICTURES = ("imgs_noisy", "imgs_1step", "imgs_final")


def save_pictures(system: Any, batch: dict[str, Any]) -> None:
    """Save a row of pictures: the render, its depth and normals, the ground truth if there is one,
    and the score model's noisy and denoised images.
    """
    out = system(batch)
    images = render_panels(out)
    truth = true_views(system.guidance, batch, out)
    if truth is not None:
        images.append(rgb_panel(truth[0]))
    if isinstance(system.guidance, ScoreDistillation):
        evaluated = system.guide(out, batch, guidance_eval=True)["eval"]
        images += score_panels(evaluated, out["comp_rgb"].shape[1:3])
    view, step = int(batch["index"][0]), system.true_global_step
    name = f"it{step}-{view}.png"
    system.save_image_grid(name, images, name="validation_step", step=step)
    log_picture(system.loggers, f"validation/{view}", system.get_save_path(name), step)


def render_panels(out: Mapping[str, Any]) -> list[Panel]:
    """Arrange colour, depth, normals and alpha of the first view of a render."""
    depth, alpha = out["depth"][0, ..., 0], out["opacity"][0, ..., 0]
    visible = depth[alpha > 0.5]
    near, far = (float(visible.min()), float(visible.max()) + 1e-6) if len(visible) else (0.0, 1.0)
    panels = [rgb_panel(out["comp_rgb"][0]), _grey_panel(depth, (near, far), "jet")]
    if "comp_normal" in out:  # other renderers may have none
        panels.append(rgb_panel(out["comp_normal"][0]))
    return [*panels, _grey_panel(alpha, (0, 1), None)]


def score_panels(evaluated: Mapping[str, Any], size: tuple[int, int]) -> list[Panel]:
    """Arrange the score model's pictures of the first view: noisy, denoised in one step, and
    denoised in many.

    Args:
        evaluated: output of :meth:`.ScoreDistillation.evaluate`.
        size: (height, width) to which they are resized, pixels.
    """
    images = [evaluated[name][:1].movedim(-1, 1) for name in SCORE_PICTURES]
    images = [F.interpolate(x, size, mode="bilinear", align_corners=False) for x in images]
    return [rgb_panel(image[0].movedim(0, -1).clamp(0, 1)) for image in images]


def rgb_panel(image: Float[Tensor, "H W 3"]) -> Panel:
    return {"type": "rgb", "img": image, "kwargs": {"data_format": "HWC"}}


def _grey_panel(image: Float[Tensor, "H W"], data_range: Any, cmap: Any) -> Panel:
    options = {"cmap": cmap, "data_range": data_range}
    return {"type": "grayscale", "img": image, "kwargs": options}


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
