"""The Ray actor that makes asset after asset in one process, with the launcher's own functions.

Networks, compiled kernels and extensions stay loaded. Nothing else passes from one asset to the
next: every random draw is a function of the seed (``core/streams.py``)."""

import contextlib
import errno
import gc
import os
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple, Optional

from .. import __version__, register_parts
from ..core.errors import UserError, raised_in
from ..core.launcher import train_alone
from ..models.loaded import keep_loaded, load_counts
from . import assets
from .assets import Job, Recipe, Source
from .board import Beat, Reporter
from .heartbeat import Heartbeat
from .ledger import FAILED, FINISHED
from .storage import Place, Unreachable

STOPPED, BLOCKED, NO_MEMORY = "stopped", "blocked", "no memory"
"""Outcomes beside ``ledger.STATES``: stopped with a checkpoint; the results can't be written; out
of memory.
"""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
SECONDS_FOR_LOCK = 60
"""How long an asset's folder may still be locked by a process of an earlier, killed driver."""


class Setting(NamedTuple):
    """What a worker needs besides the job. It is passed with each job, since Ray restarts a killed
    worker without calling :meth:`Worker.hello`.
    """

    number: int
    """Index of the worker, from 0."""
    recipe: Recipe
    place: Place
    board: Any
    """The handle of a :class:`.board.Board`."""
    start: str
    """The folder that the farm was started in: relative paths and ``custom/`` are found there."""
    session: str
    """Identifier of one start of the driver."""
    retries: int
    """How often an asset is tried again in a session after its worker has died."""


class Worker:
    """Makes assets."""

    setting: Setting
    is_ready = False

    def hello(self, setting: Setting) -> str:
        """Prepare this process; return the version of the package in it.

        Raises:
            UserError: the folder that the farm was started in doesn't exist on this machine.
        """
        self.setting = setting
        if self.is_ready:
            return __version__
        if not os.path.isdir(setting.start):
            raise UserError(
                f"{socket.gethostname()} has no folder {setting.start}: start the farm in a "
                "folder that all machines share"
            )
        os.chdir(setting.start)
        train_alone()  # before Lightning is imported, which reads the variables
        import torch

        torch.set_num_threads(setting.recipe.cores)
        keep_loaded()
        register_parts()
        self.is_ready = True
        return __version__

    def make(self, job: Job, setting: Setting) -> dict[str, Any]:
        """Make an asset, or resume it from its checkpoint, and return its outcome.

        Returns:
            ``state``, one of ``ledger.STATES``, :data:`STOPPED`, :data:`BLOCKED` or
            :data:`NO_MEMORY`; ``error`` unless it is finished; and what ``result.json`` holds.
        """
        try:
            self.hello(setting)
            earlier = self.setting.place.finished(job.row)
            if earlier is not None:
                return {"state": FINISHED, **earlier}
            return self._make(job)
        except SystemExit as stop:
            if raised_in(stop, "ray."):  # which ends this process
                raise
            from ..launch.experiment import foreign_exit

            return outcome_of(foreign_exit(stop))
        except Exception as error:
            return outcome_of(error)
        finally:
            gc.collect()

    def _make(self, job: Job) -> dict[str, Any]:
        folder = self.setting.place.work_folder(job.row)
        if marked(folder):  # an earlier session chose it, and this one resumes its checkpoint
            job = job._replace(saves_memory=True)
        elif job.saves_memory:
            self.setting.place.discard(job.row)  # what was made with the other configuration
        folder.mkdir(parents=True, exist_ok=True)
        if job.saves_memory:
            mark(folder)
        attempt, session_attempt = count_attempts(folder, self.setting.session)
        if session_attempt > self.setting.retries + 1:
            times = session_attempt - 1
            error = f"its worker died or hung {times} times, as if the memory didn't suffice"
            return {"state": NO_MEMORY, "error": error}
        self.setting.place.fetch_checkpoint(job.row)
        began = time.monotonic()
        reset_peak_memory()
        with written_log(folder / "log.txt"):
            run, code = self._run(job, folder, attempt)
        if code:
            self.setting.place.keep_checkpoint(job.row)
            return {"state": STOPPED, "error": f"stopped by signal {code - 128}"}
        seconds = round(time.monotonic() - began, 3)
        result = {**result_of(job, folder, run), "seconds": seconds, "attempts": attempt}
        if not assets.has_files(result):
            raise UserError(f"the run has left no files in {folder}")
        assets.write_result(folder, result)
        self.setting.place.publish(job.row)
        return {"state": FINISHED, **result}

    def _run(self, job: Job, folder: Path, attempt: int) -> tuple[Any, int]:
        """Train an asset with the launcher; return its run and exit code."""
        from ..launch.experiment import prepare
        from ..launch.options import parse_arguments

        report = Reporter(self._send, answer_of)
        report(Beat(job.row.name, attempt, "starting", 0, 0), now=True)
        heartbeat = Heartbeat(
            job.row.name,
            attempt,
            report,
            lambda: signal.raise_signal(signal.SIGTERM),
            lambda: self.setting.place.keep_checkpoint(job.row),
        )
        with written_sources(assets.all_sources(self.setting.recipe, job)) as configs:
            root = folder.parents[1]
            argv = assets.launch_arguments(self.setting.recipe, job, configs, root)
            args = parse_arguments(argv)
            return run_when_unlocked(
                lambda: prepare(args, argv, callbacks=[heartbeat], records_code=False)
            )

    def _send(self, beat: Beat) -> Any:
        return self.setting.board.report.remote(self.setting.number, beat)


def result_of(job: Job, folder: Path, run: Any) -> dict[str, Any]:
    """Return what a finished run has made, and where."""
    geometry = run.system.geometry
    return {
        "key": job.row.key,
        "hash": assets.digest(folder),
        "files": [path.relative_to(folder).as_posix() for path in assets.exported(folder)],
        "picture": assets.picture(folder),
        "page": assets.newest(folder, "it*-export/view.html"),
        "scores": assets.scores(folder),
        "steps": run.trainer.global_step,
        "gaussians": len(geometry) if hasattr(geometry, "__len__") else 0,
        "megabytes": peak_megabytes(),
        "bytes": assets.stored_bytes(folder),
        "saves_memory": job.saves_memory,
        "host": socket.gethostname(),
        "process": os.getpid(),
        "loads": load_counts(),
    }


def answer_of(handle: Any) -> Optional[bool]:
    """Return the board's answer if it has come; None also if the board is gone."""
    import ray

    try:
        ready, _ = ray.wait([handle], timeout=0)
        return ray.get(ready[0]) if ready else None
    except ray.exceptions.RayError:
        return None


def run_when_unlocked(prepared: Callable[[], Any]) -> tuple[Any, int]:
    """Run as soon as the folder's lock is free; return the run and its exit code.

    A process of a killed driver may hold the lock for a while. ``prepared`` makes the run, and is
    called again after each wait, since that process may have written newer checkpoints.

    Raises:
        FolderInUse: the folder is still locked after :data:`SECONDS_FOR_LOCK`.
    """
    from ..launch.folder_lock import FolderInUse

    deadline = time.monotonic() + SECONDS_FOR_LOCK
    while True:
        run = prepared()
        try:
            return run, run.run()
        except FolderInUse:
            if time.monotonic() > deadline:
                raise
            time.sleep(0.5)


# Files
# --------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def written_sources(sources: list[Source]) -> Iterator[list[str]]:
    """Write the YAML files as the driver read them; yield their paths."""
    with tempfile.TemporaryDirectory() as folder:
        paths = []
        for i, source in enumerate(sources):
            path = Path(folder, f"{i}-{Path(source.name).stem}.yaml")
            path.write_bytes(source.content)
            paths.append(str(path))
        yield paths


@contextlib.contextmanager
def written_log(path: Path) -> Iterator[None]:
    """Append what a run prints, and the traceback of its error, to a file."""
    with open(path, "a", buffering=1, encoding="utf-8", errors="backslashreplace") as file:
        with contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
            try:
                yield
            except Exception:
                traceback.print_exc()
                raise


def count_attempts(folder: Path, session: str) -> tuple[int, int]:
    """Note one more attempt in an asset's folder; return how many there were, and how many of them
    in this session.
    """
    path = folder / "attempts.txt"
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"{session} {socket.gethostname()} {os.getpid()}\n")
    lines = path.read_text(encoding="utf-8").splitlines()
    return len(lines), sum(line.startswith(f"{session} ") for line in lines)


def mark(folder: Path) -> None:
    """Record that an asset's folder is made with the low-memory configuration."""
    (folder / "saves_memory.txt").touch()


def marked(folder: Path) -> bool:
    """Return whether :func:`mark` was called for the folder."""
    return (folder / "saves_memory.txt").is_file()


# Errors and memory
# --------------------------------------------------------------------------------------------------


def outcome_of(error: Exception) -> dict[str, Any]:
    """Return the outcome of an asset that ended with an error."""
    text = f"{error}" if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    state = NO_MEMORY if is_memory_error(error) else BLOCKED if is_blocked(error) else FAILED
    return {"state": state, "error": text[:2000] or type(error).__name__}


def chain(error: Optional[BaseException]) -> Iterator[BaseException]:
    """Yield an error and the errors that caused it."""
    while error is not None:
        yield error
        error = error.__cause__ or error.__context__


def is_memory_error(error: BaseException) -> bool:
    torch = sys.modules.get("torch")
    kinds = (MemoryError, torch.OutOfMemoryError) if torch else (MemoryError,)
    return any(
        isinstance(cause, kinds) or "DefaultCPUAllocator: can't allocate" in str(cause)
        for cause in chain(error)
    )


def is_blocked(error: BaseException) -> bool:
    """Return whether other assets would fail in the same way: a full disk, or a store that can't
    be reached.
    """
    return any(
        isinstance(cause, Unreachable) or (isinstance(cause, OSError) and cause.errno in FULL)
        for cause in chain(error)
    )


def reset_peak_memory() -> None:
    """Begin to measure the peak of this process's memory (Linux), or of the GPU's."""
    import torch

    if torch.cuda.is_available():
        torch.cuda.reset_peak_memory_stats()
    with contextlib.suppress(OSError):
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")


def peak_megabytes() -> float:
    """Return the peak since :func:`reset_peak_memory`, of the GPU where there is one."""
    import torch

    if torch.cuda.is_available():
        return round(torch.cuda.max_memory_allocated() / 2**20, 1)
    try:
        status = Path("/proc/self/status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    peaks = [line.split()[1] for line in status.splitlines() if line.startswith("VmHWM")]
    return round(int(peaks[0]) / 1024, 1) if peaks else 0.0
