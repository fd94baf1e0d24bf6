"""Numbers of a step, held-out scores and validation pictures for the run's loggers, such as
TensorBoard.
"""

from collections.abc import Iterable, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.host_copies import DelayedReads
from ..core.images import read as read_image
from ..host import info

LOGGED_SCORES = ("psnr", "ssim", "multi_face", "floater_mass")


class StepLog:
    """Logs the numbers of training steps in order. Those of a GPU are logged when they have
    arrived, so that the host doesn't wait for the GPU; see ``reads``.
    """

    def __init__(self) -> None:
        self.reads = DelayedReads()

    def write(self, trainer: Any, numbers: Mapping[str, Any], shown: Iterable[str] = ()) -> None:
        """Log numbers of the training step that has just ended, values or tensors of one element,
        also for callbacks, and those ``shown`` on the progress bar. Lightning's ``log_dict`` takes
        about a millisecond of processor time for each.
        """
        on_gpu = {
            name: value.detach()
            for name, value in numbers.items()
            if isinstance(value, Tensor) and value.is_cuda
        }
        known = {name: None if name in on_gpu else float(value) for name, value in numbers.items()}
        late = tuple(on_gpu)  # not the tensors, whose memory is needed
        epoch = trainer.current_epoch
        step = trainer.global_step - 1  # as Lightning, which counts these steps from 0

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
            self.reads.flush()


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
