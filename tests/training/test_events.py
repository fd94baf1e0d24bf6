"""The numbers of a step: in the loggers, on the progress bar, and for callbacks."""

import csv
from types import SimpleNamespace
from unittest.mock import Mock

import pytest
import torch

from tests.training.runs import launch, length, run_folder
from threestudio_gaussiandreamer.core.devices import HostCopy
from threestudio_gaussiandreamer.metrics import psnr
from threestudio_gaussiandreamer.splatting.cpu import backend as cpu
from threestudio_gaussiandreamer.training import events, system
from threestudio_gaussiandreamer.training.data import GaussianDreamerDataModule


@pytest.fixture
def trainer():
    return SimpleNamespace(
        callback_metrics={}, progress_bar_metrics={}, loggers=[Mock()], global_step=10,
        current_epoch=0, checkpoint_callbacks=[SimpleNamespace(monitor=None)],
    )  # fmt: skip


def logged(trainer):
    """Return the steps and the numbers that the logger was given."""
    return [(c.kwargs["step"], c.args[0]) for c in trainer.loggers[0].log_metrics.mock_calls]


def test_numbers_reach_loggers_progress_bar_and_callbacks(trainer):
    events.StepLog().write(trainer, {"loss": torch.tensor(2.5), "gaussians": 7}, ["gaussians"])
    assert logged(trainer) == [(9, {"loss": 2.5, "gaussians": 7.0, "epoch": 0})]
    trainer.loggers[0].save.assert_called_once()
    assert trainer.callback_metrics == {"loss": torch.tensor(2.5), "gaussians": torch.tensor(7.0)}
    assert trainer.progress_bar_metrics == {"gaussians": 7.0}


def test_numbers_that_arrive_late_are_logged_at_their_own_step(trainer, monkeypatch):
    """As from a GPU."""
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    log = events.StepLog()
    log.write(trainer, {"loss": torch.tensor(1.0)}, ["loss"])
    trainer.global_step, trainer.current_epoch = 11, 1
    log.write(trainer, {"loss": torch.tensor(2.0)})
    assert not logged(trainer) and not trainer.progress_bar_metrics
    log.reads.poll(wait=True)
    assert logged(trainer) == [(9, {"loss": 1, "epoch": 0}), (10, {"loss": 2, "epoch": 1})]
    assert trainer.progress_bar_metrics == {"loss": 1.0}
    monkeypatch.setattr(HostCopy, "ready", lambda copy: False)
    trainer.checkpoint_callbacks = [object(), SimpleNamespace(monitor="loss")]
    events.StepLog().write(trainer, {"loss": torch.tensor(1.0)})
    assert trainer.callback_metrics == {"loss": torch.tensor(1.0)}


@pytest.mark.skipif(cpu.unavailable() is not None, reason=str(cpu.unavailable()))
def test_a_run_logs_each_number_once_and_its_guidances_error(tmp_path, painted_box, monkeypatch):
    """At the steps of the learning rates; no truth is rendered for it."""
    expected, report = [], system.GaussianDreamerSystem.report

    def compare(own, out, batch, *numbers):
        truth = events.true_views(own.guidance, batch, out)
        expected.append(psnr(out["comp_rgb"].detach(), truth).item())
        with monkeypatch.context() as without:
            without.delattr(events, "true_views")
            report(own, out, batch, *numbers)

    monkeypatch.setattr(system.GaussianDreamerSystem, "report", compare)
    assert launch(tmp_path, painted_box, *length(4), "trainer.log_every_n_steps=2") == 0
    with open(run_folder(tmp_path) / "csv_logs" / "version_0" / "metrics.csv") as file:
        rows = list(csv.DictReader(file))
    for name in ("loss", "dB", "gaussians", "train/loss_sds", "train/grad_norm", "lr-Adam/means"):
        assert [row["step"] for row in rows if row[name]] == ["1", "3"], name
    found = [float(row["dB"]) for row in rows if row["dB"]]
    assert found == pytest.approx(expected[1::2], abs=1e-4) and len(expected) == 4


@pytest.mark.parametrize(
    ("options", "steps", "announced"),
    [
        ({"train_views": 8}, 2, [(8, 16, 24)]),
        ({"train_views": 8}, 1, []),
        ({}, 9, []),
        ({"train_views": 8, "height": [16, 32], "resolution_milestones": [3]}, 9, []),
    ],
)
def test_views_of_a_pool_are_announced_if_most_are_drawn_and_none_moves(options, steps, announced):
    data = GaussianDreamerDataModule({"batch_size": 4, "height": 32, "width": 48, **options})
    data.setup("fit")
    found = []
    truth = SimpleNamespace(prefetch=lambda c2w, fovy, *size: found.append((len(c2w), *size)))
    renderer = SimpleNamespace(cfg=SimpleNamespace(downsample=2))
    own = {"trainer": SimpleNamespace(datamodule=data, max_steps=steps), "renderer": renderer}
    own |= {"guidance": SimpleNamespace(truth=truth), "global_step": 0, "device": "cpu"}
    events.prefetch_truth(SimpleNamespace(**own))
    assert found == announced
