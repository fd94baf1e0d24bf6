"""The Ray actor that makes asset after asset in one process, with the launcher's own functions.
Networks, compiled kernels and extensions stay loaded; nothing else passes from one to the next."""

import contextlib
import errno
import gc
import hashlib
import os
import shutil
import signal
import socket
import sys
import tempfile
import time
import traceback
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from .. import __version__, register_parts
from ..core.command import foreign_exit
from ..core.errors import UserError, raised_in
from ..core.launcher import train_alone
from ..core.options import is_number
from ..host import pl
from ..models.model_files import keep_loaded, load_counts
from ..view.run_files import RunFiles, section
from .board import Beat
from .place import ASSETS, FAILED, FINISHED, STOPPED, AnotherRow, Place, Unreachable, variant
from .recipe import Job, Recipe, all_sources, launch_arguments

BLOCKED, NO_MEMORY, REFUSED = "blocked", "no memory", "refused"
"""Outcomes beside the states of an asset: the results can't be written; out of memory; what there
is was made from another row."""
FULL = (errno.ENOSPC, errno.EDQUOT, errno.EROFS)
SECONDS_BETWEEN = 1.0
"""Shortest time between two reports of a worker."""
SECONDS_FOR_LOCK = 60
"""How long an asset's folder may still be locked by a process of an earlier, killed driver."""
NOT_EXPORTED = (".json", ".html", ".png")
"""Reports and pages beside the exported files, which may hold times."""
SCORES = ("psnr", "ssim", "multi_face")


class Setting(NamedTuple):
    """What the workers need besides the job."""

    recipe: Recipe
    place: Place
    board: Any
    """The handle of a :class:`.board.Board`."""
    start: str
    """Where the farm was started: relative paths and ``custom/`` are found there."""
    session: str
    """Identifier of one start of the driver."""
    retries: int
    """How often an asset is tried again in a session after its worker has died."""
    version: str = __version__


class Worker:
    """Makes assets."""

    is_ready = False

    def hello(self, setting: Setting) -> None:
        """Prepare this process; raises UserError for another version, or a missing folder."""
        if self.is_ready:
            return
        host, version = socket.gethostname(), setting.version
        if version != __version__:
            install = f"pip install threestudio-gaussiandreamer=={version} there"
            raise UserError(f"{host} has {__version__}; the farm is of {version}: {install}")
        if not os.path.isdir(setting.start):
            shared = "start the farm in a folder that all machines share"
            raise UserError(f"{host} has no folder {setting.start}: {shared}")
        os.chdir(setting.start)
        train_alone()  # before Lightning is imported, which reads the variables
        import torch

        torch.set_num_threads(setting.recipe.cores)
        keep_loaded()
        register_parts()
        self.is_ready = True

    def make(self, job: Job, number: int, setting: Setting) -> dict[str, Any]:
        """Make an asset, or resume it from its checkpoint, with the worker of this number; return
        ``state``, FINISHED with what ``result.json`` holds, or FAILED, STOPPED, :data:`BLOCKED`,
        :data:`NO_MEMORY` or :data:`REFUSED` with ``error``.
        """
        self.number, self.setting = number, setting
        try:
            # here too, since Ray restarts a killed worker without it
            self.hello(setting)
            return setting.place.finished(job.row) or self._make(job)
        except SystemExit as stop:
            if raised_in(stop, "ray."):  # which ends this process
                raise
            return outcome_of(foreign_exit(stop))
        except Exception as error:
            return outcome_of(error)
        finally:
            gc.collect()

    def _make(self, job: Job) -> dict[str, Any]:
        import torch

        place = self.setting.place
        folder = place.work_folder(job.row)
        attempt, session_attempt = count_attempts(folder, self.setting.session, job)
        if session_attempt > self.setting.retries + 1:
            times = session_attempt - 1
            error = f"its worker died or hung {times} times, as if the memory didn't suffice"
            return {"state": NO_MEMORY, "error": error}
        place.fetch_checkpoint(job.row, job.saves_memory)
        began = time.monotonic()
        if torch.cuda.is_available():
            torch.cuda.reset_peak_memory_stats()
        with written_log(folder / "log.txt"):
            run, code = self._run(job, folder, attempt)
        if code:
            place.keep_checkpoint(job.row, job.saves_memory)
            return {"state": STOPPED, "error": f"stopped by signal {code - 128}"}
        seconds = round(time.monotonic() - began, 3)
        result = {"state": FINISHED, **result_of(job, folder, run), "seconds": seconds}
        result |= {"attempts": attempt, "worker_seconds": job.worker_seconds(time.time())}
        if not any(map(result.get, ("files", "picture", "page"))):
            raise UserError(f"the run has left no files in {folder}")
        place.publish(job.row, result)
        return result

    def _run(self, job: Job, folder: Path, attempt: int) -> tuple[Any, int]:
        """Train an asset with the launcher; return its run and exit code."""
        from ..launch import experiment
        from ..launch.options import parse_arguments
        from ..launch.run_folder import FolderInUse

        heartbeat = Heartbeat(job, attempt, self.number, self.setting)
        deadline = time.monotonic() + SECONDS_FOR_LOCK
        with tempfile.TemporaryDirectory() as temporary:
            names = []
            for i, source in enumerate(all_sources(self.setting.recipe, job)):
                names.append(f"{temporary}/{i}-{Path(source.name).stem}.yaml")
                Path(names[-1]).write_bytes(source.content)  # as the driver read it
            where = [f"exp_root_dir={folder.parents[1]}", f"name={ASSETS}", f"tag={folder.name}"]
            where += ["use_timestamp=false", "resume=auto"]
            argv = launch_arguments(self.setting.recipe, job, names, *where)
            args = parse_arguments(argv)
            while True:
                # each time, since the process that has the lock may have written checkpoints
                run = experiment.prepare(args, argv, callbacks=[heartbeat], records_code=False)
                try:
                    return run, run.run()
                except FolderInUse:
                    if time.monotonic() > deadline:
                        raise
                    time.sleep(0.5)


@contextlib.contextmanager
def written_log(path: Path) -> Iterator[None]:
    """Append what a run prints, and the traceback of its error, to a file."""
    file = open(path, "a", buffering=1, encoding="utf-8", errors="backslashreplace")
    with file, contextlib.redirect_stdout(file), contextlib.redirect_stderr(file):
        try:
            yield
        except Exception:
            traceback.print_exc()
            raise


def count_attempts(folder: Path, session: str, job: Job) -> tuple[int, int]:
    """Note one more attempt in an asset's folder, which is emptied if earlier ones had the other
    configuration; return how many there were with this one, and how many of them in this session.
    Raises AnotherRow if the folder's checkpoints are of another row.
    """
    path, made_with = folder / "attempts.txt", variant(job.row, job.saves_memory)
    lines = path.read_text(encoding="utf-8").splitlines() if path.exists() else []
    earlier = [line.split() for line in lines if line.strip()]
    # earlier versions noted no key, or the key alone and the configuration by a file
    made = [words[1] if len(words) == 4 else job.row.key for words in earlier]
    saved = variant(job.row, (folder / "saves_memory.txt").exists())
    if not all(text.startswith(job.row.key) for text in made):
        raise AnotherRow(job.row)
    if any((saved if text == job.row.key else text) != made_with for text in made):
        shutil.rmtree(folder, ignore_errors=True)
        earlier = []
    folder.mkdir(parents=True, exist_ok=True)
    with open(path, "a", encoding="utf-8") as file:
        file.write(f"{session} {made_with} {socket.gethostname()} {os.getpid()}\n")
    return len(earlier) + 1, sum(words[0] == session for words in earlier) + 1


class Heartbeat(pl.Callback):
    """Report a run's steps, at most one a second; when the farm stops, end it with a checkpoint."""

    def __init__(self, job: Job, attempt: int, number: int, setting: Setting) -> None:
        self.job, self.attempt, self.number, self.setting = job, attempt, number, setting
        self.due, self.asked = 0.0, False
        self.beat("starting", 0)

    def on_train_batch_end(self, trainer: Any, *args: Any) -> None:
        self.setting.place.keep_checkpoint(self.job.row, self.job.saves_memory)
        stopping = self.beat("training", trainer.global_step, max(trainer.max_steps, 0))
        if stopping and not self.asked:
            self.asked = True
            signal.raise_signal(signal.SIGTERM)

    def on_validation_batch_end(self, *args: Any) -> None:
        self.beat("validating", args[4] + 1)

    def on_test_batch_end(self, *args: Any) -> None:
        self.beat("rendering", args[4] + 1)

    def beat(self, stage: str, step: int, steps: int = 0) -> bool:
        """Tell the board, unless it is being restarted; return whether the farm is stopping."""
        if time.monotonic() < self.due:
            return False
        stopping = self.report(Beat(self.job.row.name, self.attempt, stage, step, steps))
        self.due = time.monotonic() + SECONDS_BETWEEN
        return stopping

    def report(self, beat: Beat) -> bool:
        import ray

        try:
            return ray.get(self.setting.board.report.remote(self.number, beat), timeout=1)
        except ray.exceptions.RayError:
            return False


def outcome_of(error: Exception) -> dict[str, Any]:
    """Return the outcome of an asset that ended with an error."""
    causes: list[BaseException] = [error]
    while (cause := causes[-1].__cause__ or causes[-1].__context__) is not None:
        causes.append(cause)
    torch = sys.modules.get("torch")
    no_memory = (MemoryError, torch.OutOfMemoryError) if torch else MemoryError
    state = REFUSED if isinstance(error, AnotherRow) else FAILED
    if any(isinstance(c, no_memory) or "DefaultCPUAllocator: can't" in str(c) for c in causes):
        state = NO_MEMORY
    # other assets would fail in the same way
    elif any(isinstance(c, Unreachable) or getattr(c, "errno", None) in FULL for c in causes):
        state = BLOCKED
    text = f"{error}" if isinstance(error, UserError) else f"{type(error).__name__}: {error}"
    return {"state": state, "error": text[:2000] or type(error).__name__}


def result_of(job: Job, folder: Path, run: Any) -> dict[str, Any]:
    """Return what a finished run has made, and where."""
    import torch

    geometry, files = run.system.geometry, RunFiles(folder)
    page = files.export and files.export / "view.html"
    made = {"picture": files.picture, "page": page if page and page.is_file() else None}
    measured = section(files.scores, "result")
    return {
        "key": job.row.key,
        "hash": digest(folder),
        "files": [path.relative_to(folder).as_posix() for path in exported(folder)],
        **{name: path and path.relative_to(folder).as_posix() for name, path in made.items()},
        "scores": {name: measured[name] for name in SCORES if is_number(measured.get(name))},
        "steps": run.trainer.global_step,
        "gaussians": len(geometry) if hasattr(geometry, "__len__") else 0,
        "megabytes": round(torch.cuda.max_memory_allocated() / 2**20, 1),
        "bytes": sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()),
        "saves_memory": job.saves_memory,
        "host": socket.gethostname(),
        "loads": load_counts(),
    }


def exported(folder: Path) -> list[Path]:
    """List the exported files of an asset, sorted."""
    found = folder.glob("save/it*-export/**/*")
    return sorted(p for p in found if p.is_file() and p.suffix not in NOT_EXPORTED)


def digest(folder: Path) -> str:
    """Return the digest of the exported files, which a single run with these arguments has."""
    total = hashlib.sha256()
    for path in exported(folder):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(folder).as_posix()} {content}\n".encode())
    return total.hexdigest()
