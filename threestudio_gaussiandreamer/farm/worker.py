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

from .. import register_parts
from ..core.errors import UserError, raised_in
from ..core.launcher import train_alone
from ..models.loaded import keep_loaded
from .board import Beat, Heartbeat
from .place import FAILED, FINISHED, STOPPED, Place, Unreachable, another_row, has_files
from .recipe import Job, Recipe, Source, all_sources, launch_arguments
from .results import reset_peak_memory, result_of

BLOCKED, NO_MEMORY = "blocked", "no memory"
"""Outcomes beside the states of an asset: the results can't be written; out of memory."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
SECONDS_FOR_LOCK = 60
"""How long an asset's folder may still be locked by a process of an earlier, killed driver."""
SAVES_MEMORY = "saves_memory.txt"
"""Marks an asset's folder that is made with the low-memory configuration."""


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

    def hello(self, setting: Setting) -> None:
        """Prepare this process.

        Raises:
            UserError: the folder that the farm was started in doesn't exist on this machine.
        """
        self.setting = setting
        if self.is_ready:
            return
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

    def make(self, job: Job, setting: Setting) -> dict[str, Any]:
        """Make an asset, or resume it from its checkpoint, and return its outcome.

        Returns:
            ``state``: FINISHED, with what ``result.json`` holds; or FAILED, STOPPED,
            :data:`BLOCKED` or :data:`NO_MEMORY`, with ``error``.
        """
        try:
            self.hello(setting)
            return self.setting.place.finished(job.row) or self._make(job)
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
        place = self.setting.place
        folder = place.work_folder(job.row)
        if (folder / SAVES_MEMORY).is_file():
            # an earlier session chose it, and this one resumes its checkpoint
            job = job._replace(saves_memory=True)
        elif job.saves_memory:
            place.discard(job.row)  # what was made with the other configuration
        folder.mkdir(parents=True, exist_ok=True)
        if job.saves_memory:
            (folder / SAVES_MEMORY).touch()
        attempt, session_attempt = count_attempts(folder, self.setting.session, job)
        if session_attempt > self.setting.retries + 1:
            times = session_attempt - 1
            error = f"its worker died or hung {times} times, as if the memory didn't suffice"
            return {"state": NO_MEMORY, "error": error}
        place.fetch_checkpoint(job.row)
        began = time.monotonic()
        reset_peak_memory()
        with written_log(folder / "log.txt"):
            run, code = self._run(job, folder, attempt)
        if code:
            place.keep_checkpoint(job.row)
            return {"state": STOPPED, "error": f"stopped by signal {code - 128}"}
        seconds = round(time.monotonic() - began, 3)
        result = {"state": FINISHED, **result_of(job, folder, run), "seconds": seconds}
        result |= {"attempts": attempt, "worker_seconds": job.worker_seconds(time.time())}
        if not has_files(result):
            raise UserError(f"the run has left no files in {folder}")
        place.publish(job.row, result)
        return result

    def _run(self, job: Job, folder: Path, attempt: int) -> tuple[Any, int]:
        """Train an asset with the launcher; return its run and exit code."""
        from ..launch.experiment import prepare
        from ..launch.options import parse_arguments

        heartbeat = Heartbeat(
            job.row.name,
            attempt,
            self._report,
            lambda: signal.raise_signal(signal.SIGTERM),
            lambda: self.setting.place.keep_checkpoint(job.row),
        )
        with written_sources(all_sources(self.setting.recipe, job)) as configs:
            argv = launch_arguments(self.setting.recipe, job, configs, folder.parents[1])
            args = parse_arguments(argv)
            return run_when_unlocked(
                lambda: prepare(args, argv, callbacks=[heartbeat], records_code=False)
            )

    def _report(self, beat: Beat) -> bool:
        """Tell the board; return whether the farm is stopping. A board that is being restarted
        isn't waited for.
        """
        import ray

        try:
            return ray.get(self.setting.board.report.remote(self.setting.number, beat), timeout=1)
        except ray.exceptions.RayError:
            return False


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


def count_attempts(folder: Path, session: str, job: Job) -> tuple[int, int]:
    """Note one more attempt in an asset's folder; return how many there were, and how many of them
    in this session.

    Raises:
        UserError: the folder's checkpoints are of another row.
    """
    path = folder / "attempts.txt"
    with open(path, "a+", encoding="utf-8") as file:
        file.seek(0)
        earlier = [line.split() for line in file]
        # earlier versions noted no key
        if any(len(words) == 4 and words[1] != job.row.key for words in earlier):
            raise another_row(job.row)
        file.write(f"{session} {job.row.key} {socket.gethostname()} {os.getpid()}\n")
    return len(earlier) + 1, sum(words[0] == session for words in earlier) + 1


# Errors
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
