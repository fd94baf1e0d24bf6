"""The driver hands assets to the workers, notes what became of them, and watches for workers that
hang."""

import sys
import time
from collections import Counter, deque
from collections.abc import Iterator
from typing import Any, NamedTuple, Optional

from tqdm import tqdm

from ..core.errors import UserError
from ..core.files import json_text
from .board import Beat
from .place import ASSETS, FAILED, FAILURE, FINISHED, STOPPED
from .recipe import Job, repeat_command
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


class Driver:
    """Gives all remaining assets to the workers.

    Args:
        ray: the module ``ray``, connected to a cluster.
        workers: handles of :class:`.worker.Worker`.
        settings: of the workers, in the same order.
        jobs: the assets that aren't finished; the iterator is advanced when a worker is idle.
        hang: seconds without a finished step after which a worker is restarted.
        total: number of assets of the farm.
        done: how many were finished before.
    """

    def __init__(
        self,
        ray: Any,
        workers: list[Any],
        settings: list[Setting],
        jobs: Iterator[Job],
        hang: float,
        total: int,
        done: int,
    ) -> None:
        self.ray, self.workers, self.settings = ray, workers, settings
        _, self.recipe, self.place, self.board, *_ = settings[0]
        self.jobs, self.hang, self.total, self.done = jobs, hang, total, done
        self.idle = deque(range(len(workers)))
        self.running: dict[Any, Running] = {}
        self.again: deque[Job] = deque()
        self.killed: dict[int, Beat] = {}
        self.counts: Counter = Counter()
        self.errors: list[str] = []
        self.obstacle: Optional[str] = None
        self.began, self.look_due = time.monotonic(), 0.0
        # only on terminals; elsewhere a line per asset
        self.bar = tqdm(total=total, initial=done, unit="asset", disable=None, dynamic_ncols=True)

    def run(self) -> None:
        """Make the assets.

        Raises:
            UserError: the results can't be written, or the first assets all fail with one message.
            KeyboardInterrupt: Ctrl-C; the workers have written checkpoints.
        """
        try:
            self.fill()
            while self.running:
                self.step()
        except (KeyboardInterrupt, SystemExit):
            print("\nstopping: the workers write checkpoints; once more to stop at once")
            self.stop()
            raise
        finally:
            self.bar.close()
        if self.obstacle:
            raise UserError(self.obstacle)

    def step(self) -> None:
        """Wait up to :data:`POLL` seconds for outcomes and hand out new assets; each :data:`POLL`
        seconds restart hung workers and show what the workers do.
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

    def fill(self) -> None:
        """Give an asset to each worker that has none."""
        while self.idle:
            job = self.again.popleft() if self.again else next(self.jobs, None)
            if job is None:
                return
            job = job._replace(handed_out=time.time())
            number = self.idle.popleft()
            handle = self.workers[number].make.remote(job, self.settings[number])
            self.running[handle] = Running(number, job)

    def stop(self) -> None:
        """Let all workers write a checkpoint and end."""
        self.tell_board_to_stop()
        deadline = time.monotonic() + SECONDS_TO_STOP
        while self.running and time.monotonic() < deadline:
            ready, _ = self.ray.wait(list(self.running), timeout=POLL)
            for handle in ready:
                self.collect(handle)

    # Outcomes
    # ----------------------------------------------------------------------------------------------

    def collect(self, handle: Any) -> None:
        """Note the outcome of an asset."""
        number, job = self.running.pop(handle)
        self.idle.append(number)
        outcome = self.outcome(handle)
        state = outcome["state"]
        if state == FINISHED:
            self.note(job, FINISHED, f"{outcome.get('seconds', 0):.1f} s")
            return
        job, error = job._replace(spent=job.worker_seconds(time.time())), outcome["error"]
        if state == NO_MEMORY and self.recipe.low_memory and not job.saves_memory:
            self.record(job, STOPPED, error)
            self.note(job, "again with less memory", error)
            self.again.append(job._replace(saves_memory=True))
            self.restart(number)
        elif state in (FAILED, NO_MEMORY):
            self.fail(job, error)
        else:
            self.record(job, STOPPED, error)
            if state == BLOCKED:
                self.block(error)

    def outcome(self, handle: Any) -> dict[str, Any]:
        """Return what the worker returned, or what Ray says about its death."""
        try:
            return self.ray.get(handle)
        except self.ray.exceptions.RayError as error:
            said = (str(error).strip().splitlines() or [type(error).__name__])[0][:500]
            if isinstance(error, self.ray.exceptions.RayActorError):
                said = f"its worker can't be restarted: {said}"
            return {"state": FAILED, "error": said}

    def fail(self, job: Job, error: str) -> None:
        """Note a failed asset; end the farm if the first assets all failed with one message."""
        self.record(job, FAILED, error)
        self.note(job, FAILED, error)
        self.errors.append(error)
        if not self.done + self.counts[FINISHED] and self.errors == [error] * SAME_ERRORS:
            self.block(
                f"the first {SAME_ERRORS} assets have failed alike, so the farm ends: {error}"
            )

    def record(self, job: Job, state: str, error: str) -> None:
        """Write the record of an attempt that ended without a result."""
        record = {"state": state, "key": job.row.key, "error": error}
        record |= {"command": repeat_command(self.recipe, job), "worker_seconds": job.spent}
        content = json_text(record, indent=1).encode()
        try:
            self.place.write({f"{ASSETS}/{job.row.name}/{FAILURE}": content})
        except UserError as problem:  # such as a full disk
            self.block(str(problem))

    def block(self, error: str) -> None:
        """Hand out no more assets, and let the workers write checkpoints; :meth:`run` then raises
        the first of these errors.
        """
        self.obstacle = self.obstacle or error
        self.tell_board_to_stop()

    def note(self, job: Job, state: str, text: str) -> None:
        """Count and print the outcome of an asset, and off terminals how much is left."""
        self.counts[state] += 1
        made = self.counts[FINISHED] + self.counts[FAILED]
        self.bar.update(self.done + made - self.bar.n)
        left = self.total - self.done - made
        if self.bar.disable and made and left:
            seconds = (time.monotonic() - self.began) / made * left
            text += f" ({self.done + made} of {self.total}, {tqdm.format_interval(seconds)} left)"
        self.bar.write(f"{job.row.name}: {state}: {text}", file=sys.stderr)

    # Workers
    # ----------------------------------------------------------------------------------------------

    def look_after_workers(self) -> None:
        """Restart hung workers, and show what the workers do."""
        try:
            beats = self.ray.get(self.board.read.remote(), timeout=2)
        except self.ray.exceptions.RayError:
            return  # the board's process is being restarted
        self.restart_hung(beats)
        shown = [f"{beat.name} {beat.stage} {beat.step}/{beat.steps}" for beat, _ in beats.values()]
        failed = f"{self.counts[FAILED]} failed, " if self.counts[FAILED] else ""
        self.bar.set_postfix_str(failed + ", ".join(shown))

    def restart_hung(self, beats: dict[int, tuple[Beat, float]]) -> None:
        """Restart workers that have finished no step for ``hang`` seconds; Ray calls
        :meth:`.worker.Worker.make` again with the same asset.
        """
        for number, job in self.running.values():
            beat, seconds = beats.get(number, (None, 0.0))
            hangs = beat is not None and beat.name == job.row.name and seconds > self.hang
            if hangs and self.killed.get(number) != beat:
                self.killed[number] = beat
                reason = f"no step for {seconds:.0f} s ({beat.stage} {beat.step})"
                self.note(job, "restarted", reason)
                self.restart(number)

    def restart(self, number: int) -> None:
        self.ray.kill(self.workers[number], no_restart=False)

    def tell_board_to_stop(self) -> None:
        try:
            self.ray.get(self.board.stop.remote(), timeout=5)
        except self.ray.exceptions.RayError:
            pass  # it is being restarted; the workers are stopped without checkpoints
