"""What the farm prints while it works: a line per worker and a total, redrawn on a terminal;
elsewhere a line per finished asset."""

import sys
import time
from collections import Counter
from typing import Any, Optional

from .board import Beat
from .ledger import FAILED, FINISHED

BAR = 24
WIDTH = 110


class Display:
    """Counts what is done, estimates the end and prints both.

    Args:
        total: number of assets of the farm.
        done: how many are finished already.
        stream: where to print.
    """

    def __init__(self, total: int, done: int, stream: Any = None) -> None:
        self.total, self.done = total, done
        self.stream = stream or sys.stderr
        self.live = self.stream.isatty()
        self.counts: Counter = Counter()
        self.lines = 0
        self.start_clock()

    def start_clock(self) -> None:
        self.began = time.monotonic()

    def note(self, name: str, state: str, text: str) -> None:
        """Count and print the outcome of an asset."""
        self.counts[state] += 1
        self._clear()
        print(f"{name}: {state}{': ' if text else ''}{text}", file=self.stream, flush=True)
        if not self.live:
            print(self.total_line(), file=self.stream, flush=True)

    def draw(self, beats: dict[int, tuple[Beat, float]], running: dict[int, str]) -> None:
        """Redraw the lines of the workers on a terminal.

        Args:
            beats: the board's content.
            running: names of the assets that are being made, by worker.
        """
        if not self.live:
            return
        self._clear()
        lines = [worker_line(i, name, beats.get(i)) for i, name in sorted(running.items())]
        lines.append(self.total_line())
        print("\n".join(lines), file=self.stream, flush=True)
        self.lines = len(lines)

    def total_line(self) -> str:
        finished, failed = self.done + self.counts[FINISHED], self.counts[FAILED]
        return (
            f"{finished} of {self.total} finished{f', {failed} failed' if failed else ''}, "
            f"{duration(time.monotonic() - self.began)}{self._estimate()}"
        )

    def _estimate(self) -> str:
        made = self.counts[FINISHED] + self.counts[FAILED]
        left = self.total - self.done - made
        if not made or not left:
            return ""
        seconds = (time.monotonic() - self.began) / made * left
        return f", about {duration(seconds)} left"

    def _clear(self) -> None:
        if self.lines:
            print(f"\x1b[{self.lines}A\x1b[J", end="", file=self.stream)
        self.lines = 0


def worker_line(number: int, name: str, last: Optional[tuple[Beat, float]]) -> str:
    """Return the line of one worker, such as "0 [####....] training 600/1200  a_fox"."""
    if last is None or last[0].name != name:
        return f"{number:3} [{'.' * BAR}] waiting for a process  {name}"[:WIDTH]
    beat, seconds = last
    filled = int(BAR * beat.step / beat.steps) if beat.steps else 0
    steps = f"{beat.step}/{beat.steps}" if beat.steps else f"{beat.step or ''}"
    still = f", {duration(seconds)} without a step" if seconds > 60 else ""
    bar = "#" * filled + "." * (BAR - filled)
    return f"{number:3} [{bar}] {beat.stage} {steps}{still}  {name}"[:WIDTH]


def duration(seconds: float) -> str:
    """Format a duration, such as "1 h 05 min"."""
    if seconds < 60:
        return f"{seconds:.0f} s"
    if seconds < 3600:
        return f"{seconds // 60:.0f} min {seconds % 60:02.0f} s"
    return f"{seconds // 3600:.0f} h {seconds % 3600 // 60:02.0f} min"
