"""What the workers are doing now. The board's process imports this module and little else."""

import time
from typing import NamedTuple


class Beat(NamedTuple):
    """The last report of a worker."""

    name: str
    attempt: int
    stage: str
    step: int
    steps: int = 0
    """Number of steps of the stage; 0 if unknown."""


class Board:
    """A Ray actor that holds the last report of each worker. Its answers say whether the farm is
    stopping, so that Ctrl-C reaches workers on every machine."""

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
