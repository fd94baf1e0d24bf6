"""Commands that the studio starts, in processes of their own, one at a time."""

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import threading
import traceback
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from pathlib import Path
from typing import Any, Optional

from ..view.run_files import read_json

PACKAGE, WORKER = __package__.partition(".")[0], "studio.worker"
ENVIRONMENT = {"HF_HUB_OFFLINE": "1", "PYTHONUNBUFFERED": "1"}
"""No request leaves the machine: the message about missing weights has the command for them."""
TAIL, LINES, LABEL = 20_000, 12, 200
"""Bytes and lines of the output, and characters of a label, that are shown."""
PROGRESS = re.compile(r"\d+%\||\?it/s|\?, \?")
"""Is in the lines of progress bars."""
numbers = count(1)


@dataclass
class Job:
    """A command, such as a run.

    Attributes:
        label: what it is called, text of any kind.
        argv: its arguments.
        module: without the package; :data:`WORKER` is the launcher.
        done: called at its end.
        folder: of its output, and of what the worker writes.
    """

    label: str
    argv: Sequence[str]
    module: str = WORKER
    done: Callable[["Job"], None] = lambda job: None
    number: int = field(default_factory=lambda: next(numbers))
    folder: Path = Path("/nonexistent")
    process: Optional[subprocess.Popen] = None
    paused: bool = False
    failure: str = ""

    def run(self) -> None:
        """Start the process and wait for its end; raises OSError or ValueError if it can't."""
        self.folder = Path(tempfile.mkdtemp(prefix="studio-"))
        live = [str(self.folder)] if self.module == WORKER else []
        command = [sys.executable, "-m", f"{PACKAGE}.{self.module}", *live, *self.argv]
        with open(self.folder / "output", "wb") as output:
            # a session of its own: Ctrl-C is the studio's, which passes it on
            options = {"stdin": subprocess.DEVNULL, "stdout": output, "stderr": output}
            options |= {"env": os.environ | ENVIRONMENT, "start_new_session": True}
            self.process = subprocess.Popen(command, **options)
        self.process.wait()

    def pause(self, paused: bool) -> None:
        """Let the process sleep, or go on."""
        if self.process is not None and self.process.poll() is None:
            self.paused = paused
            self.process.send_signal(signal.SIGSTOP if paused else signal.SIGCONT)

    def stop(self) -> None:
        """Stop it as Ctrl-C does, also in a pause."""
        self.pause(False)
        if self.process is not None and self.process.poll() is None:
            self.process.send_signal(signal.SIGINT)

    def shown(self) -> dict[str, Any]:
        """Return what a page shows of it: the last lines without progress bars, the error that it
        has ended with, and what the worker has noted last.
        """
        lines, error, code = [], self.failure, self.process and self.process.poll()
        if (self.folder / "output").is_file():
            with open(self.folder / "output", "rb") as output:
                output.seek(max(os.path.getsize(output.name) - TAIL, 0))
                text = output.read().decode(errors="replace")
            found = (line.rpartition("\r")[2].rstrip() for line in text.split("\n"))
            lines = [line for line in found if line and not PROGRESS.search(line)][-LINES:]
        if code not in (None, 0, 128 + signal.SIGINT):
            said = [i for i, line in enumerate(lines) if line.startswith("error: ")]
            how = signal.Signals(-code).name if code < 0 else f"exit code {code}"
            how += " (out of memory?)" if code == -signal.SIGKILL else ""
            failed = [f"the process has failed: {how}", *lines[-4:]]
            error = "\n".join(lines[said[-1] :] if said else failed)
        found = {"id": self.number, "label": self.label[:LABEL], "lines": lines, "error": error}
        status = read_json(self.folder / "status.json", dict)
        return found | {"status": status, "paused": self.paused}


class Lane:
    """Jobs, of which one runs at a time, in the order in which they were added."""

    def __init__(self) -> None:
        self.waiting: list[Job] = []
        self.current: Optional[Job] = None
        self.last: Optional[Job] = None
        self._added = threading.Condition()
        threading.Thread(target=self._work, daemon=True).start()

    def add(self, job: Job) -> None:
        with self._added:
            self.waiting.append(job)
            self._added.notify()

    def remove(self, number: Optional[int] = None) -> None:
        """Remove a waiting job, or all of them."""
        with self._added:
            self.waiting = [job for job in self.waiting if number not in (None, job.number)]

    def close(self) -> None:
        """Remove the waiting jobs, stop the current one, and wait for its end."""
        self.remove()
        if (job := self.current) is not None and job.process is not None:
            job.stop()
            job.process.wait()
        for job in filter(None, (self.current, self.last)):
            shutil.rmtree(job.folder, ignore_errors=True)

    def _work(self) -> None:
        while True:
            with self._added:
                self._added.wait_for(lambda: self.waiting)
                self.current = job = self.waiting.pop(0)
            try:
                job.run()
            except (OSError, ValueError) as error:  # a full disk; a NUL in a prompt
                job.failure = f"error: {error}"
            earlier, self.last, self.current = self.last, job, None
            if earlier is not None:
                shutil.rmtree(earlier.folder, ignore_errors=True)
            try:
                job.done(job)
            except Exception:  # the next job may succeed
                traceback.print_exc()
