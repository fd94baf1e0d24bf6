"""Held-out scores and validation pictures for the run's loggers, such as TensorBoard."""

from collections.abc import Iterable, Mapping
from typing import Any

from ..core.images import read as read_image
from ..host import info

LOGGED_SCORES = ("psnr", "ssim", "multi_face", "floater_mass")


def log_scores(
    loggers: Iterable[Any], scores_by_key: Mapping[str, Mapping[str, Any]], views: int
) -> None:
    """Print the scores on so many held-out views, and log ``held_out/psnr`` (dB) and the others at
    their ``step``.

    ``LightningModule.log`` isn't allowed where the last score is made, in ``on_fit_end``."""
    loggers = list(loggers)
    for key, scores in scores_by_key.items():
        values = {f"held_out/{name}": float(scores[name]) for name in LOGGED_SCORES}
        for logger in loggers:
            logger.log_metrics(values, step=scores["step"])
        info(f"{key}: {scores['psnr']:.2f} dB, SSIM {scores['ssim']:.4f} on {views} held-out views")


def log_picture(loggers: Iterable[Any], tag: str, path: str, step: int) -> None:
    """Add the picture at ``path`` to every TensorBoard logger; the others have no pictures, or get
    them from the host.
    """
    for logger in loggers:
        add = getattr(logger.experiment, "add_image", None)
        if add is not None:
            add(tag, read_image(path), step, dataformats="HWC")
