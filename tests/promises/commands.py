"""Run the commands as a user does, inside this process, since importing torch takes longer than a
run: ``launch`` is the documented ``main``, ``command`` is ``python -m``.
"""

import contextlib
import io
import os
import resource
import runpy
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

from threestudio_gaussiandreamer.launch.experiment import main

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(__file__).parent / "data"
SMOKE = ["--config", "smoke.yaml", "--train"]


class Result(NamedTuple):
    """What a command has left: its exit code and what it wrote."""

    code: int
    out: str
    err: str

    @property
    def said(self) -> str:
        """Both outputs."""
        return self.out + self.err


def launch(*arguments: str | os.PathLike) -> Result:
    """Run ``python launch.py`` on the CPU."""
    return _captured(lambda: main([*map(str, arguments), "--gpu", "cpu"]))


def command(module: str, *arguments: str | os.PathLike) -> Result:
    """Run ``python -m threestudio_gaussiandreamer.<module>``."""

    def run() -> int:
        before = sys.argv
        sys.argv = [module, *map(str, arguments)]
        try:
            runpy.run_module(f"threestudio_gaussiandreamer.{module}", None, "__main__", True)
        finally:
            sys.argv = before
        return 0

    return _captured(run)


def _captured(run) -> Result:
    out, err = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            code = run()
        except SystemExit as stop:
            code = int(stop.code or 0)
    return Result(code, out.getvalue(), err.getvalue())


def refused(result: Result, *words: str) -> None:
    """Assert exit code 2 and one message with these words, without a traceback."""
    assert result.code == 2 and "Traceback" not in result.said, result
    assert sum(line.startswith("error: ") for line in result.err.splitlines()) == 1, result.err
    for word in words:
        assert word in result.err, f"{word!r} isn't in: {result.err}"


def check_only() -> list[str]:
    """Return arguments with which a run ends when its configuration has been accepted, before any
    work: the folder of its results is below a file.
    """
    Path("a-file").touch()
    return ["exp_root_dir=a-file/below"]


def accepted(result: Result) -> bool:
    """Whether a run with :func:`check_only` has ended for that reason alone."""
    return result.code == 2 and "can't be written: Not a directory" in result.err


@contextlib.contextmanager
def full_disk(limit: int) -> Iterator[None]:
    """Let no file of this process grow beyond ``limit`` bytes."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
