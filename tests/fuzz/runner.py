"""Run damaged files through a target, one after the other, each with a limit of time and memory,
and classify the outcomes.
"""

import os
import signal
import tempfile
import traceback
import tracemalloc
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

from tests.fuzz.target import Misread, Target
from tests.fuzz.targets import TARGETS, mutant
from threestudio_gaussiandreamer.core.errors import UserError

SECONDS = 10.0
"""CPU time that one file may take; the slowest valid one takes a tenth of a second."""
FIXED_BYTES, PER_BYTE = 24 << 20, 64
"""Memory that Python may allocate for a file: fixed, and per byte of the file."""


class Outcome(NamedTuple):
    """The outcome of one input: "refused" with a UserError, "read" correctly, or "failed"."""

    kind: str
    detail: str = ""


class Hang(BaseException):
    """The time limit; derives from BaseException so that the code under test can't catch it."""


def outcomes(name: str, indices: Iterable[int], seed: int) -> Iterator[tuple[int, Outcome]]:
    """Yield the outcome of each damaged file of these indices."""
    for index in indices:
        yield index, outcome_of(TARGETS[name], mutant(name, seed, index))


def outcome_of(target: Target, data: bytes) -> Outcome:
    """Return the outcome of one file, in a temporary folder."""
    with tempfile.TemporaryDirectory() as folder, _in_folder(folder):
        path = Path(folder, "input" + target.suffix)
        path.write_bytes(data)
        with _traced(target.traced) as peak:
            outcome = _run(target, path)
        if outcome.kind != "failed" and peak() > FIXED_BYTES + PER_BYTE * len(data):
            return Outcome("failed", f"memory: {peak() >> 20} MiB for a file of {len(data)} bytes")
    return outcome


@contextmanager
def _traced(traced: bool) -> Iterator[Callable[[], int]]:
    """Yield a function that returns the peak memory of Python and NumPy, bytes; 0 if not traced."""
    if traced:
        tracemalloc.start()
    most = 0
    try:
        yield lambda: most
    finally:
        if traced:
            most = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()


def _run(target: Target, path: Path) -> Outcome:
    try:
        with _time_limit(SECONDS):
            target.exercise(path)
        return Outcome("read")
    except UserError as error:
        return Outcome("refused", str(error)[:200])
    except Misread as error:
        return Outcome("failed", f"misread: {error}")
    except Hang:
        return Outcome("failed", f"hang: more than {SECONDS:g} s of CPU time")
    except Exception as error:
        frame = traceback.extract_tb(error.__traceback__)[-1]
        return Outcome(
            "failed",
            f"crash: {type(error).__name__}: {str(error)[:120]} "
            f"({Path(frame.filename).name}:{frame.lineno})",
        )


@contextmanager
def _in_folder(folder: str) -> Iterator[None]:
    before = os.getcwd()
    os.chdir(folder)
    try:
        yield
    finally:
        os.chdir(before)


@contextmanager
def _time_limit(seconds: float) -> Iterator[None]:
    def stop(signum: int, frame: object) -> None:
        raise Hang

    earlier = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, earlier)
