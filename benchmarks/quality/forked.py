"""Training runs in forks of a process that has imported everything, so no run waits for imports."""

import contextlib
import multiprocessing
import os
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any, TypeVar

from benchmarks.quality.runs import configs_of

Item = TypeVar("Item")
PRELOADED = ["threestudio_gaussiandreamer.launch.run", "benchmarks.quality.preload"]
ONE_THREAD = {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}
NAP = 0.1
"""Seconds between two looks at the runs."""


def train(folder: Path, overrides: dict[str, Any]) -> Path:
    """Run the base recipe with these overrides in this process; return the folder of its results.

    Its output goes to ``folder/log``.

    Raises:
        RuntimeError: the run failed; the message is the end of its output.
    """
    from threestudio_gaussiandreamer.launch import experiment

    values = [f"{name}={value}" for name, value in (overrides | {"exp_root_dir": folder}).items()]
    arguments = [*(f"--config={path}" for path in configs_of(None)), "--train", *values]
    with written_to(folder / "log"):
        run = experiment.prepare(
            experiment.parse_arguments(arguments), arguments, records_code=False
        )
        code = run.run()
    if code:
        raise RuntimeError((folder / "log").read_text()[-3000:])
    return folder / "demo/run/save"


@contextlib.contextmanager
def written_to(path: Path) -> Iterator[None]:
    """Send what this process writes to standard output and error to a file."""
    before = [os.dup(stream) for stream in (1, 2)]
    with open(path, "wb") as file:
        try:
            for stream in (1, 2):
                os.dup2(file.fileno(), stream)
            yield
        finally:
            for stream, own in zip((1, 2), before, strict=True):
                os.dup2(own, stream)
                os.close(own)


def results(
    function: Callable[[Item], Any], items: Iterable[Item], jobs: int, deadline: float
) -> Iterator[tuple[Item, Any]]:
    """Call ``function`` for the items, each in a fork of its own; yield items with their results,
    or their exceptions, as they end. What runs at the deadline is stopped.

    Args:
        deadline: of ``time.monotonic()``.
    """
    os.environ.update(ONE_THREAD)
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload(PRELOADED)
    with context.Pool(jobs, maxtasksperchild=1) as pool:
        waiting = {item: pool.apply_async(function, (item,)) for item in items}
        while waiting and time.monotonic() < deadline:
            for item in [item for item, result in waiting.items() if result.ready()]:
                try:
                    yield item, waiting.pop(item).get()
                except Exception as error:
                    yield item, error
            time.sleep(NAP)
