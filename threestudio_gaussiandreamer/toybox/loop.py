"""The training loop of all networks of the toybox, with an exponential moving average of the
weights. All random draws are functions of (seed, stage, step), so that a training resumes exactly.
"""

import itertools
import math
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Optional

import numpy as np
import torch
from torch import Tensor, nn
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader

from ..core.checkpoint_file import entries_below, load_file, save_file
from ..core.command import restore_handlers, set_handlers
from ..core.errors import UserError
from ..core.files import write_file
from ..core.streams import numpy_generator
from . import views
from .views import Shards

EMA_DECAY = 0.999
WARMUP, DECAY_SHARE = 200, 0.3
"""Steps of the rate's linear warm-up, and the last fraction of a training, where it decreases."""
CLIP_GRADIENT = 1.0
LOG_EVERY, SAVE_SECONDS = 50, 300.0


Batches = Callable[[int], Any]
"""Makes the batch of a step, a named tuple of tensors and numbers; sent to worker processes."""


@dataclass(frozen=True)
class StepData:
    """The batches of one stage's shards by step. Each pass over a shard visits its rows (pictures,
    or objects) in random order; an incomplete last batch is dropped."""

    shards: Shards
    batch: int
    pool: int
    """Number of shards that are visited cyclically."""
    stream: str
    """Name of the streams of random numbers."""
    make: Callable[[int, np.ndarray, np.random.Generator], Any]
    """Makes the batch of these rows of a shard."""
    per_object: bool = False
    """Whether rows are objects instead of pictures."""

    def __call__(self, step: int) -> Any:
        seed, count = self.shards.seed, self.shards.objects
        count *= 1 if self.per_object else self.shards.views
        batch = min(self.batch, count)
        visit, place = divmod(step, count // batch)
        rows = numpy_generator(seed, f"{self.stream}-rows", visit).permutation(count)
        rows = rows[place * batch : (place + 1) * batch]
        rng = numpy_generator(seed, f"{self.stream}-batch", step)
        return self.make(visit % self.pool, rows, rng)


def mixed_batch(first: Batches, second: Batches, every: int, step: int) -> Any:
    """Make one batch in ``every`` of ``first``, the others of ``second``, of each without gaps."""
    cycle, place = divmod(step, every)
    return second(cycle * (every - 1) + place - 1) if place else first(cycle)


def moved(batch: Any, device: torch.device) -> Any:
    """Return a named tuple of tensors and numbers on ``device``."""
    on_it = (v.to(device, non_blocking=True) if torch.is_tensor(v) else v for v in batch)
    return type(batch)(*on_it)


def torch_generator(rng: np.random.Generator) -> torch.Generator:
    """Return a torch generator with the next number of ``rng`` as its seed."""
    return torch.Generator().manual_seed(int(rng.integers(2**63)))


def normal(rng: np.random.Generator, shape: Sequence[int]) -> torch.Tensor:
    """Draw standard normal numbers, float32."""
    return torch.from_numpy(rng.standard_normal(tuple(shape), dtype=np.float32))


def checkpoint_path(folder: Path, name: str) -> Path:
    """Return the path of a stage's checkpoint."""
    return Path(folder) / f"{name}.pt"


def is_trained(folder: Path, *names: str) -> bool:
    """Return whether there is a checkpoint of any of these stages."""
    return any(checkpoint_path(folder, name).exists() for name in names)


def averaged_weights(folder: Path, name: str) -> dict[str, Tensor]:
    """Read the averaged weights of a stage's checkpoint."""
    path = checkpoint_path(folder, name)
    if not path.exists():
        raise UserError(f"{path} is missing: train the stage {name!r} first")
    return entries_below(load_file(path)["ema"], "module.")


@dataclass(frozen=True)
class Options:
    """The options of a training, those of the command line in ``train.py``."""

    folder: Path
    seed: int = 0
    device: str = "cpu"
    pool: int = 40
    precision: str = "float32"
    batch: Optional[int] = None
    workers: int = 0

    @property
    def shards(self) -> Shards:
        return Shards(self.folder / "shards", self.seed, objects=views.OBJECTS)


class Stage(ABC):
    """What the training of one network needs."""

    name: ClassVar[str]
    batch_size: ClassVar[int]
    learning_rate: ClassVar[float]
    images: ClassVar[int]
    """Of a full training."""

    def __init__(self, options: Options) -> None:
        self.options = options
        self.device = torch.device(options.device)
        self.batch = options.batch or self.batch_size
        self.constants: dict[str, float] = {}
        """Constants that are needed to use the trained network; stored in the checkpoint."""
        self.shards = options.shards
        torch.manual_seed(options.seed)
        self.model = self.build().to(self.device)

    @abstractmethod
    def build(self) -> nn.Module:
        """Build the network, and load the networks that its training uses."""

    @abstractmethod
    def data(self) -> Batches:
        """Return the batches, on the CPU: :meth:`steps` of a function."""

    def steps(
        self, make: Callable[..., Any], *given: Any, shards: Optional[Shards] = None, **more: Any
    ) -> StepData:
        """Return the batches ``make(shards, *given, index, rows, rng)`` of these shards, by default
        the stage's own; ``more`` are further fields of :class:`StepData`."""
        shards = shards or self.shards
        fields = {"stream": self.name, "batch": self.batch, "pool": self.options.pool} | more
        return StepData(shards, make=partial(make, shards, *given), **fields)

    def batches(self, step: int) -> Iterator[Any]:
        """Yield the batches from ``step`` on, on the stage's device."""
        workers = self.options.workers
        loader = DataLoader(
            range(2**62),  # steps, of which batches are made
            batch_size=None,
            sampler=itertools.count(step),  # type: ignore[arg-type]
            collate_fn=self.data(),
            num_workers=workers,
            prefetch_factor=4 if workers else None,
            pin_memory=self.device.type == "cuda",
            multiprocessing_context="spawn" if workers else None,
        )
        return (moved(batch, self.device) for batch in loader)

    @abstractmethod
    def loss(self, model: nn.Module, batch: Any) -> tuple[Tensor, dict[str, Tensor]]:
        """Return the loss of one batch, and further scalars to log."""

    def frozen(self) -> tuple[str, ...]:
        """Return name prefixes of the parameters with which other networks were trained."""
        return ()

    def evaluate(self, model: nn.Module) -> dict[str, float]:
        """Measure the model on objects that are withheld from training."""
        return {}


@dataclass
class Progress:
    """The state of a training that is saved beside the weights."""

    step: int = 0
    images: int = 0
    seconds: float = 0.0
    history: list[dict[str, float]] = field(default_factory=list)
    """One entry for each :data:`LOG_EVERY` steps: the means of the metrics."""
    measured: dict[str, float] = field(default_factory=dict)
    """Numbers on withheld objects."""
    earlier: list[dict[str, Any]] = field(default_factory=list)
    """Device and hours of the trainings whose exported weights this one started from."""


class Training:
    """Train one stage up to a number of images, resuming from its checkpoint if there is one."""

    def __init__(self, stage: Stage) -> None:
        self.stage, self.model = stage, stage.model
        self.path = checkpoint_path(stage.options.folder, stage.name)
        self.ema = AveragedModel(self.model, multi_avg_fn=_average, use_buffers=False)
        self.optimizer = torch.optim.AdamW(
            self.model.parameters(), lr=stage.learning_rate, betas=(0.9, 0.99), weight_decay=0.01
        )
        self.progress = Progress()
        self.target, self.limit = stage.images, math.inf
        self.signum = 0
        if self.path.exists():
            self._resume()
        self._freeze()

    @property
    def done(self) -> float:
        """Fraction of the training that is done, by images or by seconds."""
        return max(self.progress.images / self.target, self.progress.seconds / self.limit)

    def run(self, images: Optional[int] = None, seconds: float = math.inf) -> Progress:
        """Train until ``images`` (default: the stage's number) have been seen or ``seconds`` of
        training have passed, those before a resumption included. A stop signal, such as Ctrl-C,
        ends it earlier: a checkpoint is saved, and ``signum`` is the signal's number."""
        self.target, self.limit = images or self.stage.images, seconds
        earlier = set_handlers(lambda number, frame: setattr(self, "signum", number))
        saved = logged = started = time.monotonic()
        progress, metrics = self.progress, []
        try:
            for batch in self.stage.batches(progress.step):
                if self.done >= 1 or self.signum:
                    break
                metrics.append(self.train_step(batch))
                now = time.monotonic()
                progress.seconds += now - started
                started = now
                if len(metrics) == LOG_EVERY:
                    self._log(metrics, now - logged)
                    logged, metrics = now, []
                if now - saved > SAVE_SECONDS:
                    saved = now
                    self.save()
            self.save()  # before the measurement, which takes memory of its own
            self._measure()
            self.save()
        finally:
            restore_handlers(earlier)
        return progress

    def train_step(self, batch: Any) -> dict[str, Tensor]:
        """Update the weights and their average once, unless the gradient isn't finite."""
        progress, device = self.progress, self.stage.device.type
        factor = rate_factor(progress.step, self.done)
        for group in self.optimizer.param_groups:
            group["lr"] = self.stage.learning_rate * factor
        rng = numpy_generator(self.stage.options.seed, f"{self.stage.name}-dropout", progress.step)
        torch.manual_seed(int(rng.integers(2**63)))
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
        metrics = {"loss": loss, "grad_norm": norm, **metrics}
        return {name: value.detach() for name, value in metrics.items()}

    def save(self) -> None:
        """Write the checkpoint and the curves."""
        cuda = self.stage.device.type == "cuda"
        content = {
            "model": self.model.state_dict(),
            "ema": self.ema.state_dict(),
            "optimizer": self.optimizer.state_dict(),
            "constants": self.stage.constants,
            "device": torch.cuda.get_device_name(self.stage.device) if cuda else "cpu",
            **vars(self.progress),
        }
        save_file(self.path, content)
        history = self.progress.history
        columns = list(history[-1]) if history else []
        rows = [columns, *([row.get(name, "") for name in columns] for row in history)]
        text = "".join(",".join(map(str, row)) + "\n" for row in rows)
        write_file(self.path.with_suffix(".csv"), text, durable=False)

    def _resume(self) -> None:
        content = load_file(self.path)
        try:
            self.model.load_state_dict(content["model"])
            self.ema.load_state_dict(content["ema"])
            self.optimizer.load_state_dict(content["optimizer"])
            self.progress = Progress(**{k: content[k] for k in vars(Progress()) if k in content})
            self.stage.constants.update(content["constants"])
        except (KeyError, TypeError, RuntimeError) as error:
            raise UserError(f"{self.path} isn't a checkpoint of this stage: {error}") from error
        print(f"{self.stage.name}: resumed after {self.progress.images} images", flush=True)

    @torch.no_grad()
    def _freeze(self) -> None:
        """Freeze parameters with which dependent networks were trained, at their averages."""
        averages = dict(self.ema.module.named_parameters())
        for name, parameter in self.model.named_parameters():
            if name.startswith(self.stage.frozen()):
                parameter.copy_(averages[name])
                parameter.requires_grad_(False)

    def _log(self, metrics: list[dict[str, Tensor]], seconds: float) -> None:
        """Print and keep the means of these steps' metrics."""
        progress, count = self.progress, len(metrics)
        rate = count * self.stage.batch / max(seconds, 1e-9)
        means = {name: float(sum(row[name] for row in metrics)) / count for name in metrics[0]}
        seen = {"images": progress.images, "seconds": round(progress.seconds, 1)}
        progress.history.append({**seen, **means})
        place = f"{self.stage.name}  {progress.images}/{self.target}  {rate:.1f}/s"
        print(place, _text(means), sep="  ", flush=True)

    @torch.no_grad()
    def _measure(self) -> None:
        """Evaluate the averaged model on withheld objects."""
        self.progress.measured = measured = self.stage.evaluate(self.ema.module.eval())
        place = f"{self.stage.name}  {self.progress.images}  withheld objects:"
        print(place, _text(measured), flush=True)


def _text(numbers: dict[str, float]) -> str:
    return "  ".join(f"{name} {value:.4g}" for name, value in numbers.items())


def _average(averages: list[Tensor], current: list[Tensor], count: Any) -> None:
    """Update an EMA whose decay is min(EMA_DECAY, (1 + n) / (10 + n)) after n steps."""
    decay = min(EMA_DECAY, (1 + float(count)) / (10 + float(count)))
    torch._foreach_lerp_(averages, current, 1 - decay)


def rate_factor(step: int, done: float) -> float:
    """Return the rate's factor: linear warm-up to 1, constant, linear decrease to 0 by ``done``."""
    return min(1.0, (step + 1) / WARMUP) * min(1.0, max(0.0, 1 - done) / DECAY_SHARE)
