"""What the workers are doing now: a small Ray actor that they report to and the driver reads.

Its answer to a worker says whether the farm is stopping, so that Ctrl-C reaches workers on every
machine."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple

from ..host import pl

SECONDS_BETWEEN = 1.0
"""Shortest time between two reports of a worker."""


class Beat(NamedTuple):
    """The last report of a worker."""

    name: str
    """Of the asset."""
    attempt: int
    stage: str
    step: int
    steps: int = 0
    """Number of steps of the stage; 0 if unknown."""


class Board:
    """Holds the last report of each worker, and since when nothing has changed in it."""

    def __init__(self) -> None:
        self.beats: dict[int, tuple[Beat, float]] = {}
        self.stopping = False

    def report(self, worker: int, beat: Beat) -> bool:
        """Note a worker's report; return whether it should stop."""
        if worker not in self.beats or self.beats[worker][0] != beat:
            self.beats[worker] = beat, time.monotonic()
        return self.stopping

    def read(self) -> dict[int, tuple[Beat, float]]:
        """Return each worker's last report, and the seconds since it changed."""
        now = time.monotonic()
        return {worker: (beat, now - since) for worker, (beat, since) in self.beats.items()}

    def stop(self) -> None:
        self.stopping = True


class Heartbeat(pl.Callback):
    """Report the steps of a run, at most one a second, and stop it when the farm is stopping.

    Args:
        report: sends a :class:`Beat`; returns whether the farm is stopping.
        stop: ends the run as SIGTERM does, with a checkpoint.
        on_step: called after each training step, such as to upload a new checkpoint.
    """

    def __init__(
        self,
        name: str,
        attempt: int,
        report: Callable[[Beat], bool],
        stop: Callable[[], None],
        on_step: Callable[[], None],
    ) -> None:
        self.name, self.attempt = name, attempt
        self.report, self.stop, self.on_step = report, stop, on_step
        self.due, self.asked = 0.0, False
        self.beat("starting", 0)

    def on_train_batch_end(self, trainer: Any, *args: Any) -> None:
        self.on_step()
        stopping = self.beat("training", trainer.global_step, max(trainer.max_steps, 0))
        if stopping and not self.asked:
            self.asked = True
            self.stop()

    def on_validation_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *args: Any
    ) -> None:
        self.beat("validating", batch_idx + 1)

    def on_test_batch_end(
        self, trainer: Any, module: Any, outputs: Any, batch: Any, batch_idx: int, *args: Any
    ) -> None:
        self.beat("rendering", batch_idx + 1)

    def beat(self, stage: str, step: int, steps: int = 0) -> bool:
        if time.monotonic() < self.due:
            return False
        stopping = self.report(Beat(self.name, self.attempt, stage, step, steps))
        self.due = time.monotonic() + SECONDS_BETWEEN
        return stopping
