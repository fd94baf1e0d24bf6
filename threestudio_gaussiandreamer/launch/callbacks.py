"""Lightning callbacks of the launcher: the record of the run, the progress bar, and checkpoints
when a signal stops training.
"""

import contextlib
import os
import signal
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Optional

import torch

from ..core.files import atomic_file
from ..core.host_copies import flush_reads
from ..core.signals import interrupt, restore_handlers, set_handlers
from ..host import info, pl, warn
from .checkpoints import AtomicCheckpointIO
from .config import dump_config
from .folder_lock import (
    free_number,
    has_checkpoints,
    set_checkpoints_aside,
    set_results_aside,
)
from .run_folder import PARSED

SECONDS_BETWEEN = 60.0
"""Shortest time between two checkpoints, seconds: a crash loses about as much training."""
SHARE_OF_TIME = 0.01
"""Largest share of the running time that is spent on writing checkpoints."""
SECONDS_SHOWN = 0.5
"""Time from one drawing of the progress bar to the next, seconds: one costs as much as a log."""
DATA_BYTES = 2**22
"""Total size up to which files beside the code of parts are copied with it."""
SOURCE_ENDINGS = (".py", ".yaml", ".h", ".cpp", ".cu", ".html", ".css", ".js", ".glsl")


class Stopped(BaseException):
    """Raised when a signal has stopped training and a checkpoint is written. It derives from
    BaseException, so that handlers of Exception don't catch it.
    """

    def __init__(self, signum: int, step: int) -> None:
        super().__init__(f"stopped by {signal.Signals(signum).name} at step {step}")
        self.signum, self.step = signum, step


class RunRecord(pl.Callback):
    """Write ``configs/raw.yaml``, ``configs/parsed.yaml``, ``code/`` and ``cmd.txt`` when the first
    stage starts, before the prior. If the folder has record and checkpoints of an earlier run, they
    are replaced together, with the first checkpoint of this one, so that a start that is refused or
    stopped leaves the earlier run as it was.

    Args:
        folder: the run's folder.
        cfg: the merged and resolved configuration.
        sources: the YAML files that were merged, and their content.
        command: the command line.
        records_code: write ``code/`` too.
    """

    def __init__(
        self,
        folder: Path,
        cfg: Any,
        sources: Sequence[tuple[Path, bytes]],
        command: str,
        records_code: bool = True,
    ) -> None:
        self.folder, self.cfg, self.sources, self.command = folder, cfg, sources, command
        self.records_code = records_code
        self._code: dict[Path, bytes] = {}
        self._is_due = self._is_read = False

    def setup(self, trainer: Any, pl_module: Any, stage: str) -> None:
        if not trainer.is_global_zero or self._is_read:
            return
        self._is_read = self._is_due = True
        if self.records_code:  # now, since the files may change before they are written
            self._code = self.read_code()
        if not (has_checkpoints(self.folder) and (self.folder / PARSED).is_file()):
            self.write()

    def write(self) -> None:
        """Write the record, unless it has been written."""
        if not self._is_due:
            return
        self._is_due = False
        self.save_configs()
        for path, content in self._code.items():
            path.parent.mkdir(parents=True, exist_ok=True)
            write_copy(path, content)
        self._code = {}
        # append, since a resumed run has several command lines
        # surrogateescape: paths on the command line may be no UTF-8
        log = self.folder / "cmd.txt"
        with open(log, "a", encoding="utf-8", errors="surrogateescape") as file:
            file.write(self.command + "\n")

    def save_configs(self) -> None:
        """Write the configuration before and after merging and resolving."""
        configs = self.folder / "configs"
        configs.mkdir(parents=True, exist_ok=True)
        for i, (path, content) in enumerate(self.sources):
            # not if the run is resumed from its own parsed.yaml: keep the original raw.yaml
            if path.resolve().parent != configs.resolve():
                write_copy(configs / (f"raw-{i}.yaml" if i else "raw.yaml"), content)
        dump_config(self.folder / PARSED, self.cfg)

    def read_code(self) -> dict[Path, bytes]:
        """Read the sources of this package and of the extensions.

        Returns:
            the content of the copies, by their paths.
        """
        package, copies = Path(__file__).parents[1], self.folder / "code"
        found = dict(read_sources(package, copies / package.name))
        if Path("custom").is_dir():
            found |= read_sources(Path("custom"), copies / "custom", DATA_BYTES)
        return found


def read_sources(
    source: Path, destination: Path, data_bytes: int = 0
) -> Iterator[tuple[Path, bytes]]:
    """Yield path and content of the copies of the source files below a folder, leaving out hidden
    files and folders, and, with a warning, what can't be read.

    Args:
        destination: the folder of the copies.
        data_bytes: copy other files too, which a part may read, up to so many bytes in total; a
            warning says if there are more.
    """
    has_data, left_out = data_bytes > 0, []
    for path in _visible_files(source):
        is_source = path.name.endswith(SOURCE_ENDINGS)
        if not is_source and not has_data:
            continue
        try:
            if not is_source and path.stat().st_size > data_bytes:
                left_out.append(path)
                continue
            content = path.read_bytes()
        except OSError as error:
            warn(f"{path} isn't copied to {destination}: {error.strerror}")
            continue
        data_bytes -= 0 if is_source else len(content)
        yield destination / path.relative_to(source), content
    if left_out:
        warn(
            f"{len(left_out)} files below {source}, such as {left_out[0]}, aren't copied to "
            f"{destination}, since they are large"
        )


def _visible_files(source: Path) -> Iterator[Path]:
    for folder, folders, names in os.walk(source):
        folders[:] = [name for name in folders if not name.startswith((".", "__pycache__"))]
        for name in names:
            path = Path(folder, name)
            if not name.startswith(".") and path.is_file():
                yield path  # an editor's lock (a broken link) or a FIFO is no file


def write_copy(path: Path, content: bytes) -> None:
    """Write a file atomically: whatever has its name, such as a link or a FIFO, is replaced."""
    with atomic_file(path, durable=False) as file:
        file.write(content)


class EarlierRunAside(pl.Callback):
    """Rename the results of an earlier run in the folder when the prior's cloud is there, and its
    checkpoints before the first one of this run, so that a start that fails leaves them in their
    place. Parts may read weights from there when they are built.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.number = folder, 0

    def on_fit_start(self, trainer: Any, pl_module: Any) -> None:
        self.number = free_number(self.folder)
        self._say(set_results_aside(self.folder, self.number))

    def set_checkpoints_aside(self) -> None:
        self._say(set_checkpoints_aside(self.folder, self.number))

    def _say(self, aside: Optional[Path]) -> None:
        if aside is not None:
            info(f"started at step 0: files of an earlier run are now in {aside}")


class ProgressBar(pl.callbacks.TQDMProgressBar):
    """Lightning's progress bar without the version number. In training it is drawn about every
    :data:`SECONDS_SHOWN`; if the output isn't a terminal, it is printed every 100 steps.
    """

    def __init__(self) -> None:
        super().__init__(refresh_rate=1 if sys.stderr.isatty() else 100)
        self._due = 0.0

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        now, is_last = time.monotonic(), batch_idx + 1 == self.train_progress_bar.total
        if self.refresh_rate > 1 or is_last or now >= self._due:
            self._due = now + SECONDS_SHOWN
            super().on_train_batch_end(trainer, pl_module, outputs, batch, batch_idx)

    def get_metrics(self, trainer: Any, pl_module: Any) -> dict[str, Any]:
        metrics = super().get_metrics(trainer, pl_module)
        metrics.pop("v_num", None)
        if "gaussians" in metrics:
            metrics["gaussians"] = int(metrics["gaussians"])  # Lightning logs floats: 1e+4
        return metrics

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        # end the bar's line, so that the next message starts on its own
        print(file=sys.stderr)


class NoProfiler(pl.profilers.PassThroughProfiler):
    """Lightning's profiler that measures nothing, without a generator around each call of a hook:
    there are dozens in a step.
    """

    _nothing = contextlib.nullcontext()

    def profile(self, action_name: str) -> contextlib.AbstractContextManager:
        return self._nothing


class LastNumbers(pl.callbacks.Callback):
    """Log the numbers of the last steps if an exception ends training."""

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        with contextlib.suppress(RuntimeError):  # of a GPU that has failed
            flush_reads(getattr(pl_module, "step_log", None))


class LearningRates(pl.callbacks.LearningRateMonitor):
    """Lightning's monitor, but the rates stay on the host: a copy of each to the GPU would wait for
    the GPU.
    """

    def on_train_batch_start(self, trainer: Any, *args: Any, **kwargs: Any) -> None:
        super().on_train_batch_start(_OnHost(trainer), *args, **kwargs)


class _OnHost:
    """A trainer whose parameters seem to be on the CPU."""

    strategy = SimpleNamespace(root_device=torch.device("cpu"))

    def __init__(self, trainer: Any) -> None:
        self._trainer = trainer

    def __getattr__(self, name: str) -> Any:
        return getattr(self._trainer, name)


class LastCheckpoint(pl.callbacks.Checkpoint):
    """Write ``last.ckpt`` after the last step, about every :data:`SECONDS_BETWEEN`, and after a
    stop signal: the current step is finished, the file written and :class:`Stopped` raised. A
    second signal stops immediately.

    Lightning calls subclasses of ``Checkpoint`` after all other callbacks, so this one saves the
    same state as ModelCheckpoint."""

    def __init__(self, last: Path, checkpoint_io: AtomicCheckpointIO) -> None:
        self.last, self.checkpoint_io = last, checkpoint_io
        self.signum = 0
        self._due = 0.0
        self._earlier: dict[int, Any] = {}

    def on_train_start(self, trainer: Any, pl_module: Any) -> None:
        self._due = time.monotonic() + SECONDS_BETWEEN
        self._earlier = set_handlers(self._ask)

    def on_train_batch_end(
        self, trainer: Any, pl_module: Any, outputs: Any, batch: Any, batch_idx: int
    ) -> None:
        is_due = time.monotonic() >= self._due or trainer.global_step == trainer.max_steps
        if _any_process(trainer, is_due or bool(self.signum)):
            self._save(trainer)
            self._stop_if_asked(trainer)

    def on_validation_end(self, trainer: Any, pl_module: Any) -> None:
        if trainer.state.fn == "fit" and not trainer.sanity_checking:
            self._stop_if_asked(trainer)

    def on_train_end(self, trainer: Any, pl_module: Any) -> None:
        self._save(trainer)  # where max_time or max_epochs ended the run
        self._restore_handlers()
        self._stop_if_asked(trainer)

    def on_exception(self, trainer: Any, pl_module: Any, exception: BaseException) -> None:
        self._restore_handlers()

    def _ask(self, signum: int, frame: Any) -> None:
        if self.signum:
            self._restore_handlers()
            interrupt(signum)
        self.signum = signum
        # not print(), which isn't reentrant in signal handlers; OSError if the terminal is closed
        with contextlib.suppress(OSError):
            os.write(
                2,
                b"\nstopping after this step and writing a checkpoint; once more to stop at once\n",
            )

    def _stop_if_asked(self, trainer: Any) -> None:
        if _any_process(trainer, bool(self.signum)):
            self._save(trainer)
            raise Stopped(self.signum or signal.SIGTERM, trainer.global_step)

    def _save(self, trainer: Any) -> None:
        """Write the checkpoint, and schedule the next one so that saving takes at most
        :data:`SHARE_OF_TIME` of the running time.
        """
        is_new = self.checkpoint_io.saved_step(self.last) != trainer.global_step
        # only the first process writes and knows the step, but all take part in saving
        if _any_process(trainer, trainer.is_global_zero and is_new):
            trainer.save_checkpoint(self.last)
        # not the time of save_checkpoint(), in which the system scores the prior once
        pause = max(SECONDS_BETWEEN, self.checkpoint_io.seconds / SHARE_OF_TIME)
        self._due = time.monotonic() + pause

    def _restore_handlers(self) -> None:
        restore_handlers(self._earlier)
        self._earlier = {}


def _any_process(trainer: Any, decision: bool) -> bool:
    """Return whether ``decision`` is true in any of the processes that train together."""
    return trainer.strategy.reduce_boolean_decision(decision, all=False)
