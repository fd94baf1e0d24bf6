"""Commands that the studio starts, in processes of their own, one at a time."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Optional

from ..view.run_files import read_json

PACKAGE, WORKER = __package__.partition(".")[0], "studio.worker"
ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "PYTHONUNBUFFERED": "1"}
"""No request leaves the machine: the message about missing weights has the command for them."""
TAIL, LABEL = 8000, 200  # bytes of the output and characters of a label that pages show
FOLDERS = tempfile.TemporaryDirectory(prefix="studio-")


@dataclass
class Job:
    """A command: its name, text of any kind, its arguments, and its module in the package, by
    default the launcher with :mod:`.worker` around it. ``done`` is called at its end.
    """

    label: str
    argv: Sequence[str]
    module: str = WORKER
    done: Callable[[], Any] = lambda: None
    number: int = field(default_factory=count(1).__next__)
    future: Optional[Future] = None
    process: Optional[subprocess.Popen] = None
    paused: bool = False

    @property
    def live(self) -> Path:
        """The folder with its output, and what the worker writes."""
        return Path(FOLDERS.name, str(self.number))

    def run(self) -> None:
        """Start the process and wait for its end."""
        self.live.mkdir()
        folder = [str(self.live)] if self.module == WORKER else []
        command = [sys.executable, "-m", f"{PACKAGE}.{self.module}", *folder, *self.argv]
        with open(self.live / "output", "wb") as output:
            # a session of its own: Ctrl-C is the studio's, which passes it on
            options = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            options |= {"env": os.environ | ENVIRONMENT, "start_new_session": True}
            self.process = subprocess.Popen(command, **options)
        self.process.wait()
        self.done()

    def control(self, stop: bool = False, paused: bool = False) -> None:
        """Let the process sleep or go on, or stop it as Ctrl-C does."""
        if self.process is not None and self.process.poll() is None:
            self.paused = paused
            self.process.send_signal(signal.SIGSTOP if paused else signal.SIGCONT)
            if stop:
                self.process.send_signal(signal.SIGINT)

    def shown(self) -> dict[str, Any]:
        """Return what a page shows: the end of its output, the exit code, the worker's notes."""
        output, code, text = self.live / "output", self.process and self.process.poll(), ""
        with contextlib.suppress(OSError), open(output, "rb") as file:
            file.seek(max(file.seek(0, os.SEEK_END) - TAIL, 0))
            text = file.read().decode(errors="replace")
        if self.future.done() and self.future.exception():  # a full disk; a NUL in a prompt
            text, code = f"error: {self.future.exception()}", code or 2
        shown = {"id": self.number, "label": self.label[:LABEL], "text": text, "code": code}
        return shown | {"status": read_json(self.live / "status.json", dict), "paused": self.paused}


class Lane:
    """Jobs, of which one runs at a time, in the order in which they were added."""

    def __init__(self) -> None:
        self._jobs: list[Job] = []
        self._pool = ThreadPoolExecutor(1)

    def add(self, job: Job) -> None:
        job.future = self._pool.submit(job.run)
        self._jobs = [*filter(None, (self.last, self.current)), *self.waiting, job]

    def remove(self, number: Optional[int] = None) -> None:
        """Remove a waiting job, or all of them."""
        for job in self.waiting:
            if number in (None, job.number):
                job.future.cancel()

    @property
    def waiting(self) -> list[Job]:
        return [job for job in self._jobs if not (job.future.running() or job.future.done())]

    @property
    def current(self) -> Optional[Job]:
        return next((job for job in self._jobs if job.future.running()), None)

    @property
    def last(self) -> Optional[Job]:
        ended = (job for job in self._jobs if job.future.done() and not job.future.cancelled())
        return next(reversed([*ended]), None)

    def close(self) -> None:
        """Remove the waiting jobs, stop the current one, and wait for its end."""
        self.remove()
        if job := self.current:
            job.control(stop=True)
        self._pool.shutdown()
