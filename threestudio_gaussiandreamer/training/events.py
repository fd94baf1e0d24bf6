"""What a run logs and shows, in loggers such as TensorBoard: numbers of a step, held-out scores,
and validation pictures, which are rows in the format of the host's ``save_image_grid``.
"""

import math
from collections.abc import Iterable, Mapping
from typing import Any, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from ..core.devices import DelayedReads
from ..guidance.base import ScoreDistillation
from ..guidance.external import truth_of
from ..host import info
from ..images import read as read_image
from .data import GaussianDreamerDataModule

LOGGED_SCORES = ("psnr", "ssim", "multi_face", "floater_mass")
SCORE_PICTURES = ("imgs_noisy", "imgs_1step", "imgs_final")
Panel = dict[str, Any]


class StepLog:
    """Logs the numbers of training steps in order; those of a GPU when they have arrived."""

    def __init__(self) -> None:
        self.reads = DelayedReads()

    def write(self, trainer: Any, numbers: Mapping[str, Any], shown: Iterable[str] = ()) -> None:
        """Log numbers of the training step that has just ended, values or tensors of one element,
        also for callbacks, and those ``shown`` on the progress bar. Lightning's ``log_dict`` takes
        about a millisecond of processor time for each.
        """
        on_gpu = {k: v.detach() for k, v in numbers.items() if isinstance(v, Tensor) and v.is_cuda}
        known = {name: None if name in on_gpu else float(value) for name, value in numbers.items()}
        late = tuple(on_gpu)  # not the tensors, whose memory is needed
        # as Lightning, which counts these steps from 0
        epoch, step = trainer.current_epoch, trainer.global_step - 1

        def log(found: Float[Tensor, " N"]) -> None:
            values = known | dict(zip(late, found.tolist(), strict=True))
            trainer.callback_metrics.update({name: torch.tensor(v) for name, v in values.items()})
            trainer.progress_bar_metrics.update({name: values[name] for name in shown})
            for logger in trainer.loggers:
                logger.log_metrics(values | {"epoch": epoch}, step=step)
                logger.save()

        flat = [number.reshape(1).double() for number in on_gpu.values()]
        self.reads.submit(torch.cat(flat or [torch.empty(0, dtype=torch.float64)]), log)
        # a monitored number must be that of the step whose checkpoint is written
        if any(getattr(saver, "monitor", None) for saver in trainer.checkpoint_callbacks):
            self.reads.poll(wait=True)


def log_scores(
    loggers: Iterable[Any], scores_by_key: Mapping[str, Mapping[str, Any]], views: int
) -> None:
    """Print scores on so many held-out views, and log ``held_out/psnr`` (dB) and others."""
    loggers = list(loggers)
    for key, scores in scores_by_key.items():
        values = {f"held_out/{name}": float(scores[name]) for name in LOGGED_SCORES}
        for logger in loggers:  # LightningModule.log isn't allowed in on_fit_end
            logger.log_metrics(values, step=scores["step"])
        info(f"{key}: {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} on {views} held-out views")


def save_pictures(system: Any, batch: dict[str, Any]) -> None:
    """Save a row of pictures: render, depth, normals, ground truth, noisy and denoised images."""
    out = system(batch)
    images, truth = _render_panels(out), true_views(system.guidance, batch, out)
    if truth is not None:
        images.append(rgb_panel(truth[0]))
    if isinstance(system.guidance, ScoreDistillation):
        evaluated = system.guide(out, batch, guidance_eval=True)["eval"]
        images += score_panels(evaluated, out["comp_rgb"].shape[1:3])
    view, step = int(batch["index"][0]), system.true_global_step
    name = f"it{step}-{view}.png"
    system.save_image_grid(name, images, name="validation_step", step=step)
    for logger in system.loggers:  # those without pictures get them from the host
        if add := getattr(logger.experiment, "add_image", None):
            picture = read_image(system.get_save_path(name))
            add(f"validation/{view}", picture, step, dataformats="HWC")


def _render_panels(out: Mapping[str, Any]) -> list[Panel]:
    """Arrange colour, depth, normals and alpha of the first view of a render."""
    depth, alpha = out["depth"][0, ..., 0], out["opacity"][0, ..., 0]
    visible = depth[alpha > 0.5]
    near, far = (float(visible.min()), float(visible.max()) + 1e-6) if len(visible) else (0.0, 1.0)
    panels = [rgb_panel(out["comp_rgb"][0]), _grey_panel(depth, (near, far), "jet")]
    if "comp_normal" in out:  # own renderers may return none
        panels.append(rgb_panel(out["comp_normal"][0]))
    return [*panels, _grey_panel(alpha, (0, 1), None)]


def score_panels(evaluated: Mapping[str, Any], size: tuple[int, int]) -> list[Panel]:
    """Arrange the score model's pictures of the first view, resized to ``size`` (height, width):
    noisy, denoised in one step, and in many, of :meth:`.ScoreDistillation.evaluate`.
    """
    images = [evaluated[name][:1].movedim(-1, 1) for name in SCORE_PICTURES]
    images = [F.interpolate(x, size, mode="bilinear", align_corners=False) for x in images]
    return [rgb_panel(image[0].movedim(0, -1).clamp(0, 1).cpu()) for image in images]


def rgb_panel(image: Float[Tensor, "H W 3"]) -> Panel:
    return {"type": "rgb", "img": image, "kwargs": {"data_format": "HWC"}}


def _grey_panel(image: Float[Tensor, "H W"], data_range: Any, cmap: Any) -> Panel:
    return {"type": "grayscale", "img": image, "kwargs": {"cmap": cmap, "data_range": data_range}}


def true_views(
    guidance: Any, batch: dict[str, Any], out: Mapping[str, Any]
) -> Optional[Float[Tensor, "B H W 3"]]:
    """Render a batch's ground truth with the background and size of ``out``; None without one."""
    truth = truth_of(guidance)
    if truth is None:
        return None
    return truth.render(batch, out["comp_rgb_bg"].detach(), size=out["comp_rgb"].shape[1:3])


def prefetch_truth(system: Any) -> None:
    """Announce all cameras of a fixed pool to the ground truth, if a run will use most of them."""
    truth, trainer = truth_of(system.guidance), system.trainer
    if truth is None or not isinstance(trainer.datamodule, GaussianDreamerDataModule):
        return
    cameras = trainer.datamodule.train_dataset
    if cameras.pool is None or len(cameras.sizes) > 1:
        return
    ((*size, batch_size),), pool = cameras.sizes, cameras.pool
    steps = math.inf if trainer.max_steps < 0 else trainer.max_steps - system.global_step
    if steps * batch_size >= len(pool.azimuth):
        size = (side // system.renderer.cfg.downsample for side in size)
        truth.prefetch(pool.c2w.to(system.device), pool.fovy.to(system.device), *size)
