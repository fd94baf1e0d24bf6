"""What the callbacks of the launcher log and show."""

from pathlib import Path
from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer.core.host_copies import DelayedReads, HostCopy
from threestudio_gaussiandreamer.launch import callbacks
from threestudio_gaussiandreamer.launch.callbacks import LastCheckpoint, ProgressBar


def test_numbers_that_have_not_arrived_are_logged_when_an_exception_ends_training(monkeypatch):
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    log, seen = SimpleNamespace(reads=DelayedReads()), []
    log.reads.submit(torch.tensor(1.0), seen.append)
    last = LastCheckpoint(Path(), None)
    last.on_exception(None, SimpleNamespace(step_log=log), KeyboardInterrupt())
    assert seen == [1.0]
    last.on_exception(None, object(), KeyboardInterrupt())  # another package's system


@pytest.fixture
def clock(monkeypatch):
    """Return a list with the time that the callbacks read, seconds."""
    now = [1000.0]
    monkeypatch.setattr(callbacks, "time", SimpleNamespace(monotonic=lambda: now[0]))
    return now


@pytest.mark.parametrize("terminal, drawn", [(True, [1, 5, 9, 10]), (False, [10])])
def test_the_progress_bar_is_drawn_by_time_and_at_the_last_step(
    monkeypatch, clock, terminal, drawn
):
    stream = SimpleNamespace(isatty=lambda: terminal)
    monkeypatch.setattr(callbacks, "sys", SimpleNamespace(stderr=stream))
    trainer = SimpleNamespace(is_global_zero=True, progress_bar_metrics={}, loggers=[])
    bar, seen = ProgressBar(), []
    bar.setup(trainer, None, "fit")
    shown = bar.train_progress_bar = SimpleNamespace(total=10, disable=False)
    shown.refresh, shown.set_postfix = lambda: None, lambda numbers: seen.append(shown.n)
    for index in range(10):
        bar.on_train_batch_end(trainer, None, None, None, index)
        clock[0] += callbacks.SECONDS_SHOWN / 4
    assert seen == drawn
