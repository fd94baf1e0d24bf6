"""What the callbacks of the launcher log and show."""

from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer.core.host_copies import DelayedReads, HostCopy
from threestudio_gaussiandreamer.launch import callbacks
from threestudio_gaussiandreamer.launch.callbacks import LastNumbers, LearningRates, ProgressBar


def test_learning_rates_are_logged_without_a_copy_to_the_device():
    logged, callbacks = [], {}
    logger = SimpleNamespace(log_metrics=lambda numbers, step: logged.append((step, numbers)))
    weight = torch.nn.Parameter(torch.ones(1))
    optimizer = torch.optim.Adam(
        [{"params": [weight], "name": "means", "lr": 0.25}, {"params": [], "name": "sh", "lr": 0.5}]
    )
    trainer = SimpleNamespace(
        loggers=[logger], optimizers=[optimizer], lr_scheduler_configs=[],
        callback_metrics=callbacks,
        _logger_connector=SimpleNamespace(should_update_logs=True),
        fit_loop=SimpleNamespace(epoch_loop=SimpleNamespace(_batches_that_stepped=3)),
        strategy=SimpleNamespace(root_device="meta"),  # on which a number can't be read
    )  # fmt: skip
    monitor = LearningRates(logging_interval="step")
    monitor.on_train_start(trainer)
    monitor.on_train_batch_start(trainer)
    assert logged == [(3, {"lr-Adam/means": 0.25, "lr-Adam/sh": 0.5})]
    assert {name: float(value) for name, value in callbacks.items()} == logged[0][1]


def test_numbers_that_have_not_arrived_are_logged_when_an_exception_ends_training(monkeypatch):
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    log, seen = SimpleNamespace(reads=DelayedReads()), []
    log.reads.submit(torch.tensor(1.0), seen.append)
    LastNumbers().on_exception(None, SimpleNamespace(step_log=log), KeyboardInterrupt())
    assert seen == [1.0]
    LastNumbers().on_exception(None, object(), KeyboardInterrupt())  # another package's system


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
