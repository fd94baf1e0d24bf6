"""What the workers are doing now: a small Ray actor that they report to and the driver reads.

Its answer to a worker says whether the farm is stopping, so that Ctrl-C reaches workers on every
machine."""

import time
from collections.abc import Callable
from typing import Any, NamedTuple, Optional

SECONDS_BETWEEN = 1.0
"""Shortest time between two reports of a worker."""


class Beat(NamedTuple):
    """The last report of a worker."""

    name: str
    """Of the asset."""
    attempt: int
    stage: str
    step: int
    steps: int
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


class Reporter:
    """Sends a worker's reports without waiting for the answers.

    Args:
        send: sends a :class:`Beat` and returns a handle of the answer.
        answer: returns the answer of a handle if it has come, else None.
    """

    def __init__(
        self, send: Callable[[Beat], Any], answer: Callable[[Any], Optional[bool]]
    ) -> None:
        self.send, self.answer = send, answer
        self.sent: Any = None
        self.due = 0.0
        self.stopping = False

    def __call__(self, beat: Beat, now: bool = False) -> bool:
        """Report; return whether the last answer was to stop.

        Args:
            now: also if the last report was less than :data:`SECONDS_BETWEEN` ago.
        """
        if not now and time.monotonic() < self.due:
            return self.stopping
        if self.sent is not None:
            self.stopping = bool(self.answer(self.sent)) or self.stopping
        self.sent = self.send(beat)
        self.due = time.monotonic() + SECONDS_BETWEEN
        return self.stopping
