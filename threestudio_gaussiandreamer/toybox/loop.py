"""The training loop of all networks of the toybox.

It saves checkpoints from which it can be resumed, keeps an exponential moving average of the
weights, and writes loss curves and contact sheets of samples.

All random draws are functions of (seed, stage, step), so a resumed training gives the same result
as an uninterrupted one.
"""

import logging
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ClassVar, Optional

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import Dataset

from ..core.checkpoint_file import save_file
from ..core.errors import UserError
from ..core.images import write as write_picture
from ..core.signals import restore_handlers, set_handlers
from .batches import batches
from .checkpoints import checkpoint_path, read_checkpoint
from .curves import write_curves
from .views import Shards

EMA_DECAY = 0.999
WARMUP, DECAY_SHARE = 200, 0.3
"""Steps of the linear warm-up of the learning rate, and the last fraction of a training, over which
it decreases linearly to zero.
"""
CLIP_GRADIENT = 1.0
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Options:
    """The options of a training."""

    folder: Path
    """The folder for shards, checkpoints, curves and sheets."""
    seed: int = 0
    device: str = "cpu"
    pool: int = 40
    """Number of shards of training data; a stage visits them in a cycle."""
    shard_objects: int = 256
    precision: str = "float32"
    """Either "float32", or "bfloat16" for autocast on GPUs and on CPUs that multiply it."""
    save_seconds: float = 300.0
    sheet_seconds: float = 1200.0
    only: str = ""
    """Substring of the names of the parameters to train; the others stay fixed."""
    rate: Optional[float] = None
    """Learning rate; None for the default of each stage."""
    batch: Optional[int] = None
    """Batch size; None for the default of each stage."""
    workers: int = 0
    """Number of processes that make batches in advance."""

    def shards_folder(self) -> Path:
        return self.folder / "shards"

    def shards(self, seed: Optional[int] = None) -> Shards:
        """Return the shards of a seed; None for that of the training."""
        seed = self.seed if seed is None else seed
        return Shards(self.shards_folder(), seed, objects=self.shard_objects)


class Stage(ABC):
    """The training of one network, ``model``; :class:`Training` also averages its weights."""

    name: ClassVar[str]
    batch_size: ClassVar[int]
    learning_rate: ClassVar[float]
    images: ClassVar[int]
    """Number of images in a full training."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.device = torch.device(options.device)
        self.batch = options.batch or self.batch_size
        self.rate = options.rate or self.learning_rate
        self.constants: dict[str, float] = {}
        """Constants that are needed to use the trained network; stored in the checkpoint."""
        torch.manual_seed(options.seed)
        self.model = self.build().to(self.device)

    @abstractmethod
    def build(self) -> nn.Module:
        """Build the network with random weights, and load the networks that its training uses."""

    @abstractmethod
    def data(self) -> Dataset:
        """Return the batches, indexed by step, on the CPU; it is sent to worker processes."""

    def batches(self, step: int) -> Iterator[Any]:
        """Yield the batches from ``step`` on, on the stage's device."""
        return batches(self.data(), step, self.device, self.options.workers)

    @abstractmethod
    def loss(self, model: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of one batch, and further scalars to log."""

    def frozen(self) -> tuple[str, ...]:
        """Return name prefixes of the parameters that stay fixed, since other networks were trained
        with them.
        """
        return ()

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Measure the model on objects that are withheld from training."""
        return {}

    def sheet(self, model: nn.Module) -> Optional[np.ndarray]:
        """Return a picture of the model's outputs, uint8 (H, W, 3); None if there is none."""
        return None

    def depends(self) -> dict[str, str]:
        """Return fingerprints of the frozen networks that this one is trained with."""
        return {}


@dataclass
class Progress:
    """The state of a training that is saved beside the weights."""

    step: int = 0
    images: int = 0
    seconds: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry for each :data:`LOG_EVERY` steps: the means of the metrics."""


LOG_EVERY = 50
SAVED = "model", "ema", "optimizer", "depends", "constants", "measured"
"""Entries of a checkpoint beside those of Progress that a resumed training needs."""


class Training:
    """Train one stage up to a number of images, resuming from its checkpoint if there is one."""

    def __init__(self, stage: Stage) -> None:
        self.stage = stage
        self.model = stage.model
        self.ema = AveragedModel(self.model, multi_avg_fn=_average, use_buffers=False)
        self.optimizer = torch.optim.AdamW(
            self.model.parameters(), lr=stage.rate, betas=(0.9, 0.99), weight_decay=0.01
        )
        self.progress = Progress()
        self.measured: dict[str, float] = {}
        self.earlier: list[dict[str, Any]] = []
        """Device and hours of the trainings whose exported weights this one started from."""
        self.target, self.limit = stage.images, math.inf
        self.signum = 0
        if self.path.exists():
            self._resume()
        self.logged = self.progress.images, self.progress.seconds
        """Images and seconds at the last log."""
        self._freeze()

    @property
    def done(self) -> float:
        """Fraction of the training that is done, by images or by seconds."""
        return max(self.progress.images / self.target, self.progress.seconds / self.limit)

    @property
    def path(self) -> Path:
        return checkpoint_path(self.stage.options.folder, self.stage.name)

    def run(self, images: Optional[int] = None, seconds: float = math.inf) -> Progress:
        """Train until ``images`` (default: the stage's number) have been seen or ``seconds`` of
        training have passed, those before a resumption included. A stop signal, such as Ctrl-C,
        ends it earlier: a checkpoint is saved, and ``signum`` is the signal's number.
        """
        self.target, self.limit = images or self.stage.images, seconds
        earlier = set_handlers(self._on_signal)
        try:
            self._loop()
        finally:
            restore_handlers(earlier)
        return self.progress

    def _loop(self) -> None:
        progress, sums = self.progress, _Sums()
        batches = self.stage.batches(progress.step)
        saved = shown = started = time.monotonic()
        for batch in batches:
            if self.done >= 1 or self.signum:
                break
            metrics = self.train_step(batch)
            now = time.monotonic()
            progress.seconds += now - started
            started = now
            if sums.add(metrics) == LOG_EVERY:
                self._log(sums.mean())
            if now - shown > self.stage.options.sheet_seconds:
                shown = now
                self._show()
            if now - saved > self.stage.options.save_seconds:
                saved = now
                self.save()
        self.save()  # before the sheet, which may fail
        self._show()
        self.save()

    def train_step(self, batch: Any) -> dict[str, Tensor]:
        """Update the weights and their average once.

        Raises:
            UserError: the gradient isn't finite; weights and average aren't changed.
        """
        progress, device = self.progress, self.stage.device.type
        factor = rate_factor(progress.step, self.done)
        for group in self.optimizer.param_groups:
            group["lr"] = self.stage.rate * factor
        mixed = self.stage.options.precision == "bfloat16"
        with torch.autocast(device, dtype=torch.bfloat16, enabled=mixed):
            loss, metrics = self.stage.loss(self.model, batch)
        self.optimizer.zero_grad(set_to_none=True)
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self.model.parameters(), CLIP_GRADIENT)
        if not norm.isfinite():
            raise UserError(
                f"{self.stage.name}: the gradient of step {progress.step} isn't finite, so training"
                f" stops; {self.path} is as it was last saved"
            )
        self.optimizer.step()
        self.ema.update_parameters(self.model)
        progress.step += 1
        progress.images += self.stage.batch
        return {"loss": loss.detach(), "grad_norm": norm, **metrics}

    def save(self) -> None:
        """Write the checkpoint and the curves.

        Raises:
            UserError: the disk is full or the folder can't be written; an existing file is kept.
        """
        content = {
            "model": self.model.state_dict(),
            "ema": self.ema.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "depends": self.stage.depends(),
            "constants": self.stage.constants,
            "measured": self.measured,
            "earlier": self.earlier,
            "device": _device_name(self.stage.device),
            "torch": str(torch.__version__),
            **vars(self.progress),
        }
        save_file(self.path, content)
        write_curves(self.path.with_suffix(".csv"), self.progress.history)

    def _resume(self) -> None:
        content = read_checkpoint(self.path, {*SAVED, *vars(Progress())})
        if content["depends"] != self.stage.depends():
            changed = [
                name
                for name, digest in self.stage.depends().items()
                if content["depends"].get(name) != digest
            ]
            raise UserError(
                f"{self.path} was trained with another {' and '.join(changed)}:"
                " put that checkpoint back, or delete this one"
            )
        self.model.load_state_dict(content["model"])
        self.ema.load_state_dict(content["ema"])
        self.optimizer.load_state_dict(content["optimizer"])
        self.progress = Progress(**{name: content[name] for name in vars(Progress())})
        self.stage.constants.update(content["constants"])
        self.measured = content["measured"]
        self.earlier = content.get("earlier", [])
        log.info("%s: resumed after %d images", self.stage.name, self.progress.images)
        if (version := content.get("torch", torch.__version__)) != torch.__version__:
            log.warning(
                "%s: begun with torch %s, continued with %s: the result differs in rounding from "
                "that of an uninterrupted training", self.stage.name, version, torch.__version__
            )  # fmt: skip

    @torch.no_grad()
    def _freeze(self) -> None:
        """Freeze parameters at their averages: those with which dependent networks were trained,
        and those that the option ``only`` leaves out.

        Raises:
            UserError: that leaves none.
        """
        prefixes, only = self.stage.frozen(), self.stage.options.only
        averages = dict(self.ema.module.named_parameters())
        for name, parameter in self.model.named_parameters():
            if name.startswith(prefixes) or only not in name:
                parameter.copy_(averages[name])
                parameter.requires_grad_(False)
        if not any(parameter.requires_grad for parameter in self.model.parameters()):
            groups = sorted({name.partition(".")[0] for name in averages})
            raise UserError(
                f"--only {only!r}: {self.stage.name!r} has no such parameters to train; the parts "
                f"of the network are {', '.join(groups)}"
            )

    def _log(self, means: dict[str, float]) -> None:
        progress = self.progress
        images, seconds = self.logged
        rate = (progress.images - images) / max(progress.seconds - seconds, 1e-9)
        self.logged = progress.images, progress.seconds
        progress.history.append(
            {"images": progress.images, "seconds": round(progress.seconds, 1), **means}
        )
        numbers = "  ".join(f"{name} {value:.4g}" for name, value in means.items())
        print(
            f"{self.stage.name}  {progress.images}/{self.target}  {rate:.1f}/s  {numbers}",
            flush=True,
        )

    @torch.no_grad()
    def _show(self) -> None:
        """Evaluate the averaged model on withheld objects and write its sheet."""
        model = self.ema.module.eval()
        self.measured = self.stage.evaluate(model)
        if self.measured:
            text = "  ".join(f"{name} {value:.4g}" for name, value in self.measured.items())
            print(
                f"{self.stage.name}  {self.progress.images}  withheld objects: {text}", flush=True
            )
        image = self.stage.sheet(model)
        if image is not None:
            folder = self.stage.options.folder / "sheets"
            folder.mkdir(parents=True, exist_ok=True)
            write_picture(folder / f"{self.stage.name}-{self.progress.images:08d}.png", image)

    def _on_signal(self, number: int, frame: Any) -> None:
        self.signum = number


class _Sums:
    """Sums of metrics since the last log."""

    def __init__(self) -> None:
        self.count, self.values = 0, {}

    def add(self, metrics: dict[str, Tensor]) -> int:
        self.count += 1
        for name, value in metrics.items():
            self.values[name] = self.values.get(name, 0) + value.detach()
        return self.count

    def mean(self) -> dict[str, float]:
        """Return the means since the last call."""
        means = {name: float(value) / self.count for name, value in self.values.items()}
        self.count, self.values = 0, {}
        return means


def _device_name(device: torch.device) -> str:
    return torch.cuda.get_device_name(device) if device.type == "cuda" else device.type


def _average(averages: list[Tensor], current: list[Tensor], count: Any) -> None:
    """Update an EMA whose decay is min(EMA_DECAY, (1 + n) / (10 + n)) after n steps."""
    decay = min(EMA_DECAY, (1 + float(count)) / (10 + float(count)))
    torch._foreach_lerp_(averages, current, 1 - decay)


def rate_factor(step: int, done: float) -> float:
    """Return the multiplier of the learning rate: linear warm-up to 1, constant, then a linear
    decrease to zero.

    Args:
        done: fraction of the training that is done.
    """
    return min(1.0, (step + 1) / WARMUP) * min(1.0, max(0.0, 1 - done) / DECAY_SHARE)
