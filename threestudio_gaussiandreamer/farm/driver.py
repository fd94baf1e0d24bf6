"""The driver hands assets to the workers, notes their outcomes in the ledger, and watches for
workers that hang."""

import time
from collections import deque
from collections.abc import Iterator
from typing import Any, NamedTuple, Optional

from ..core.errors import UserError
from .assets import Job, repeat_command
from .board import Beat
from .display import Display
from .ledger import FAILED, FINISHED, RUNNING, Ledger
from .worker import BLOCKED, NO_MEMORY, Setting

POLL = 0.5
"""Seconds between two reads of the board, and longest wait for an outcome."""
SECONDS_TO_STOP = 60
"""How long workers may take to write their checkpoints when the farm is stopped."""
SAME_ERRORS = 3
"""The farm ends if its first assets, this many, all fail with the same message."""


class Running(NamedTuple):
    """An asset that a worker has."""

    worker: int
    job: Job
    began: float
    """When the worker got it, seconds of the monotonic clock."""


class Driver:
    """Gives all remaining assets to the workers.

    Args:
        ray: the module ``ray``, connected to a cluster.
        workers: handles of :class:`.worker.Worker`.
        settings: of the workers, in the same order.
        jobs: the assets that aren't finished; the iterator is advanced when a worker is idle.
        ledger: the farm's ledger.
        hang: seconds without a finished step after which a worker is restarted.
    """

    def __init__(
        self,
        ray: Any,
        workers: list[Any],
        settings: list[Setting],
        jobs: Iterator[Job],
        ledger: Ledger,
        hang: float,
        display: Display,
    ) -> None:
        self.ray, self.workers, self.settings = ray, workers, settings
        self.board, self.recipe = settings[0].board, settings[0].recipe
        self.jobs, self.ledger = jobs, ledger
        self.hang, self.display = hang, display
        self.idle = deque(range(len(workers)))
        self.running: dict[Any, Running] = {}
        self.again: deque[Job] = deque()
        self.killed: dict[int, Beat] = {}
        self.errors: list[str] = []
        self.obstacle: Optional[str] = None
        self.look_due = 0.0

    def run(self) -> None:
        """Make the assets.

        Raises:
            UserError: the results can't be written, or the first assets all fail with one message.
            KeyboardInterrupt: Ctrl-C; the workers have written checkpoints.
        """
        try:
            self.display.start_clock()
            self.fill()
            while self.running:
                self.step()
        except (KeyboardInterrupt, SystemExit):
            print("\nstopping: the workers write checkpoints; once more to stop at once")
            self.stop()
            raise
        if self.obstacle:
            raise UserError(self.obstacle)

    def step(self) -> None:
        """Wait up to :data:`POLL` seconds for outcomes and hand out new assets; each :data:`POLL`
        seconds restart hung workers and draw the display.
        """
        ready, _ = self.ray.wait(list(self.running), timeout=POLL)
        if ready:  # all that are there: each wait takes longer the more workers there are
            handles = list(self.running)
            ready, _ = self.ray.wait(handles, num_returns=len(handles), timeout=0)
        for handle in ready:
            self.collect(handle)
        if not self.obstacle:
            self.fill()
        if time.monotonic() >= self.look_due:
            self.look_after_workers()
            self.look_due = time.monotonic() + POLL

    def look_after_workers(self) -> None:
        """Restart hung workers, and draw the display."""
        beats = self.read_board()
        self.restart_hung(beats)
        names = {worker: job.row.name for worker, job, _ in self.running.values()}
        self.display.draw(beats, names)

    def fill(self) -> None:
        """Give an asset to each worker that has none."""
        while self.idle:
            job = self.again.popleft() if self.again else next(self.jobs, None)
            if job is None:
                return
            self.ledger.append([self.line(job, RUNNING)])
            number = self.idle.popleft()
            handle = self.workers[number].make.remote(job, self.settings[number])
            self.running[handle] = Running(number, job, time.monotonic())

    def stop(self) -> None:
        """Let all workers write a checkpoint and end."""
        self.tell_board_to_stop()
        deadline = time.monotonic() + SECONDS_TO_STOP
        while self.running and time.monotonic() < deadline:
            ready, _ = self.ray.wait(list(self.running), timeout=POLL)
            for handle in ready:
                self._collect_last(handle)

    def _collect_last(self, handle: Any) -> None:
        """Note the outcome of an asset while the farm is stopped; an error of the ledger, such as a
        full disk, is printed, so that it doesn't take the place of Ctrl-C.
        """
        try:
            self.collect(handle)
        except UserError as error:
            print(f"error: {error}")

    # Outcomes
    # ----------------------------------------------------------------------------------------------

    def collect(self, handle: Any) -> None:
        """Note the outcome of an asset."""
        number, job, began = self.running.pop(handle)
        self.idle.append(number)
        outcome = self.outcome(handle)
        state, spent = outcome["state"], round(time.monotonic() - began, 3)
        if state == FINISHED:
            self.finish(job, outcome, spent)
            return
        if state == FAILED or state == NO_MEMORY and not self.can_save_memory(job):
            self.fail(job, outcome["error"], spent)
            return
        self.ledger.append([self.line(job, RUNNING, worker_seconds=spent)])
        if state == NO_MEMORY:
            self.display.note(job.row.name, "again with less memory", outcome["error"])
            self.again.append(job._replace(saves_memory=True))
            self.restart(number)
        elif state == BLOCKED:
            self.block(outcome["error"])

    def can_save_memory(self, job: Job) -> bool:
        """Return whether an asset can be made again in less memory."""
        return bool(self.recipe.low_memory) and not job.saves_memory

    def outcome(self, handle: Any) -> dict[str, Any]:
        """Return what the worker returned, or what Ray says about its death."""
        errors = self.ray.exceptions
        try:
            return self.ray.get(handle)
        except errors.RayActorError as error:
            return {"state": FAILED, "error": f"its worker can't be restarted: {error}"}
        except errors.RayError as error:
            return {"state": FAILED, "error": first_line(error)}

    def finish(self, job: Job, outcome: dict[str, Any], spent: float) -> None:
        outcome.pop("key")
        self.ledger.append([self.line(job, **outcome, worker_seconds=spent)])
        self.display.note(job.row.name, FINISHED, f"{outcome.get('seconds', 0):.1f} s")

    def fail(self, job: Job, error: str, spent: float) -> None:
        """Note a failed asset; end the farm if the first assets all failed with one message."""
        command = repeat_command(self.recipe, job)
        more = {"error": error, "command": command, "worker_seconds": spent}
        self.ledger.append([self.line(job, FAILED, **more)])
        self.display.note(job.row.name, FAILED, error)
        self.errors.append(error)
        finished = self.display.done + self.display.counts[FINISHED]
        if not finished and self.errors == [error] * SAME_ERRORS:
            self.block(
                f"the first {SAME_ERRORS} assets have failed alike, so the farm ends: {error}"
            )

    def block(self, error: str) -> None:
        """Hand out no more assets, and let the workers write checkpoints; :meth:`run` then raises
        the first of these errors.
        """
        self.obstacle = self.obstacle or error
        self.tell_board_to_stop()

    def line(self, job: Job, state: str, **more: Any) -> dict[str, Any]:
        row = job.row
        return {"name": row.name, "key": row.key, "state": state, **more}

    # Workers
    # ----------------------------------------------------------------------------------------------

    def read_board(self) -> dict[int, tuple[Beat, float]]:
        """Return the board's content; nothing while its process is restarted."""
        try:
            return self.ray.get(self.board.read.remote(), timeout=2)
        except self.ray.exceptions.RayError:
            return {}

    def tell_board_to_stop(self) -> None:
        try:
            self.ray.get(self.board.stop.remote(), timeout=5)
        except self.ray.exceptions.RayError:
            pass  # it is being restarted; the workers are stopped without checkpoints

    def restart_hung(self, beats: dict[int, tuple[Beat, float]]) -> None:
        """Restart workers that have finished no step for ``hang`` seconds; Ray calls
        :meth:`.worker.Worker.make` again with the same asset.
        """
        for number, job, _ in self.running.values():
            beat, seconds = beats.get(number, (None, 0.0))
            hangs = beat is not None and beat.name == job.row.name and seconds > self.hang
            if hangs and self.killed.get(number) != beat:
                self.killed[number] = beat
                reason = f"no step for {seconds:.0f} s ({beat.stage} {beat.step})"
                self.display.note(job.row.name, "restarted", reason)
                self.restart(number)

    def restart(self, number: int) -> None:
        self.ray.kill(self.workers[number], no_restart=False)


def first_line(error: BaseException) -> str:
    lines = str(error).strip().splitlines() or [type(error).__name__]
    return lines[0][:500]
