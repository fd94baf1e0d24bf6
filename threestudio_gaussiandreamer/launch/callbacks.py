"""Lightning callbacks of the launcher: the record of the run, the progress bar, checkpoints."""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import count
from pathlib import Path
from typing import Any, Optional

from ..core.checkpoint_file import load_file, save_file
from ..core.command import interrupt, restore_handlers, set_handlers
from ..core.devices import flush_reads
from ..core.files import write_file
from ..host import info, pl, warn
from .config import dump_config
from .run_folder import PARSED

SECONDS_BETWEEN = 60.0
"""Shortest time between two checkpoints, seconds: a crash loses about as much training."""
SHARE_OF_TIME = 0.01
"""Largest share of the running time that is spent on writing checkpoints."""
SOURCE_ENDINGS = (".py", ".yaml", ".h", ".cpp", ".cu", ".html", ".css", ".js", ".glsl")


class Stopped(BaseException):
    """Raised when a signal has stopped training and a checkpoint is written."""

    def __init__(self, signum: int, step: int) -> None:
        self.signum, self.step = signum, step


@dataclass(eq=False)
class RunRecord(pl.Callback):
    """Write ``configs/raw.yaml``, ``configs/parsed.yaml``, ``code/`` and ``cmd.txt`` when the first
    stage starts, before the prior. The results of an earlier run in the folder are set aside when
    the prior's cloud is there, its checkpoints and record with the first checkpoint, so that a
    start that fails leaves them in their place.
    """

    folder: Path
    cfg: Any
    sources: Sequence[tuple[Path, bytes]]
    command: str
    records_code: bool
    at_zero: bool
    _files: Optional[dict[Path, bytes]] = None
    _is_due: bool = False

    def setup(self, trainer: Any, pl_module: Any, stage: str) -> None:
        if not trainer.is_global_zero or self._files is not None:
            return
        self._is_due, self._files = True, {}
        if self.records_code:  # now, since the files may change before they are written
            package, code = Path(__file__).parents[1], self.folder / "code"
            self._files |= read_sources(package, code / package.name)
            self._files |= read_sources(Path("custom"), code / "custom")
        if not (self._has_checkpoints() and (self.folder / PARSED).is_file()):
            self.write()

    def on_fit_start(self, trainer: Any, pl_module: Any) -> None:
        if not (self.at_zero and trainer.is_global_zero):
            return
        taken = {path.name for path in self.folder.glob("*-*")}
        self.number = next(n for n in count(2) if not taken & {f"ckpts-{n}", f"save-{n}"})
        save, aside = self.folder / "save", self.folder / f"save-{self.number}"
        if any(save.glob("it*")):
            aside.mkdir()
            for path in save.iterdir():
                if path.name != "prior":  # its points may serve again
                    path.rename(aside / path.name)
            info(f"started at step 0: files of an earlier run are now in {aside}")

    @contextlib.contextmanager
    def first_checkpoint(self) -> Iterator[None]:
        """Replace an earlier run's record before the first checkpoint, or after it if resumed."""
        if self.at_zero:
            if self._has_checkpoints():
                aside = (self.folder / "ckpts").rename(self.folder / f"ckpts-{self.number}")
                info(f"started at step 0: checkpoints of an earlier run are now in {aside}")
            self.write()
        yield
        self.write()

    def write(self) -> None:
        """Write the record, unless it has been written."""
        if not self._is_due:
            return
        self._is_due = False
        configs = self.folder / "configs"
        for i, (path, content) in enumerate(self.sources):
            # not if the run is resumed from its own parsed.yaml: keep the original raw.yaml
            if path.resolve().parent != configs.resolve():
                self._files[configs / (f"raw-{i}.yaml" if i else "raw.yaml")] = content
        for path, content in self._files.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_file(path, content, durable=False)
        self._files = {}
        configs.mkdir(parents=True, exist_ok=True)
        dump_config(self.folder / PARSED, self.cfg)
        # a resumed run has several command lines, and paths in them may be no UTF-8
        log = self.folder / "cmd.txt"
        with open(log, "a", encoding="utf-8", errors="surrogateescape") as file:
            file.write(self.command + "\n")

    def _has_checkpoints(self) -> bool:
        return any((self.folder / "ckpts").glob("*.ckpt"))


def read_sources(source: Path, destination: Path) -> dict[Path, bytes]:
    """Read the source files below a folder, but for hidden ones, by the paths of their copies."""
    found = {}
    for path in source.rglob("*"):
        name = path.relative_to(source)
        is_hidden = any(part.startswith((".", "__pycache__")) for part in name.parts)
        # an editor's lock (a broken link) or a FIFO is no file
        if path.suffix in SOURCE_ENDINGS and not is_hidden and path.is_file():
            try:
                found[destination / name] = path.read_bytes()
            except OSError as error:
                warn(f"{path} isn't copied to {destination}: {error.strerror}")
    return found


class ProgressBar(pl.callbacks.TQDMProgressBar):
    """Lightning's progress bar, drawn every 10 steps, or every 100 without a terminal."""

    def __init__(self) -> None:
        super().__init__(refresh_rate=10 if sys.stderr.isatty() else 100)

    def get_metrics(self, trainer: Any, pl_module: Any) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        if "gaussians" in metrics:
            metrics["gaussians"] = int(metrics["gaussians"])  # Lightning logs floats: 1e+4
        return metrics

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        print(file=sys.stderr)  # end the bar's line, so that the next message starts on its own


class AtomicCheckpointIO(pl.plugins.CheckpointIO):
    """Write and read checkpoints, the first one in the context that ``first`` returns; ``steps``
    has the step of the last one at each path, ``seconds`` is the duration of the last write.
    """

    def __init__(self, first: Callable[[], Any] = contextlib.nullcontext) -> None:
        self.first, self.seconds = first, 0.0
        self.steps: dict[str, int] = {}

    def save_checkpoint(
        self, checkpoint: dict[str, Any], path: str | os.PathLike, storage_options: Any = None
    ) -> None:
        started = time.monotonic()
        with contextlib.nullcontext() if self.steps else self.first():
            save_file(path, checkpoint)
        self.seconds = time.monotonic() - started
        self.steps[os.path.abspath(path)] = checkpoint["global_step"]

    def load_checkpoint(
        self, path: str | os.PathLike, map_location: Any = None, weights_only: Any = True
    ) -> dict[str, Any]:
        return load_file(path, "cpu" if map_location is None else map_location)

    def remove_checkpoint(self, path: str | os.PathLike) -> None:
        Path(path).unlink(missing_ok=True)


class LastCheckpoint(pl.callbacks.Checkpoint):
    """Write ``last.ckpt`` after the last step, about every :data:`SECONDS_BETWEEN`, and after a
    stop signal: the current step is finished, the file written and :class:`Stopped` raised. A
    second signal stops immediately. Lightning calls subclasses of ``Checkpoint`` last.
    """

    def __init__(self, last: Path, checkpoint_io: AtomicCheckpointIO) -> None:
        self.last, self.checkpoint_io = last, checkpoint_io
        self.signum = 0
        self._due = 0.0
        self._earlier: dict[int, Any] = {}

    def on_train_start(self, *rest: Any) -> None:
        self._due = time.monotonic() + SECONDS_BETWEEN
        self._earlier = set_handlers(self._ask)

    def on_train_batch_end(self, trainer: Any, *rest: Any) -> None:
        is_due = time.monotonic() >= self._due or trainer.global_step == trainer.max_steps
        if _any_process(trainer, is_due or bool(self.signum)):
            self._save(trainer)
            self._stop_if_asked(trainer)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self._save(trainer)  # where max_time or max_epochs ended the run
        restore_handlers(self._earlier)
        self._stop_if_asked(trainer)

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        restore_handlers(self._earlier)
        with contextlib.suppress(RuntimeError):  # of a GPU that has failed
            flush_reads(getattr(pl_module, "step_log", None))  # the numbers of the last steps

    def _ask(self, signum: int, frame: Any) -> None:
        if self.signum:
            restore_handlers(self._earlier)
            interrupt(signum)
        self.signum = signum
        said = b"\nstopping after this step and writing a checkpoint; once more to stop at once\n"
        with contextlib.suppress(OSError):  # the terminal is closed
            os.write(2, said)  # print() isn't reentrant

    def _stop_if_asked(self, trainer: Any) -> None:
        if _any_process(trainer, bool(self.signum)):
            self._save(trainer)
            raise Stopped(self.signum or signal.SIGTERM, trainer.global_step)

    def _save(self, trainer: Any) -> None:
        """Write the checkpoint, and schedule the next so that they take :data:`SHARE_OF_TIME`."""
        is_new = self.checkpoint_io.steps.get(os.path.abspath(self.last)) != trainer.global_step
        # only the first process knows the step, but all take part in saving
        if _any_process(trainer, trainer.is_global_zero and is_new):
            trainer.save_checkpoint(self.last)
        # not the time of save_checkpoint(), in which the system scores the prior once
        pause = max(SECONDS_BETWEEN, self.checkpoint_io.seconds / SHARE_OF_TIME)
        self._due = time.monotonic() + pause


def _any_process(trainer: Any, decision: bool) -> bool:
    """Return whether ``decision`` is true in any of the processes that train together."""
    return trainer.strategy.reduce_boolean_decision(decision, all=False)
