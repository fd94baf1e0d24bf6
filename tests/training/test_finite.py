"""Parameters and optimiser state that aren't finite are found and named."""

import pytest
import torch

from tests.helpers.refusals import refused
from tests.training.runs import launch, length, run_folder
from threestudio_gaussiandreamer.training import finite, system

INFINITE = "after the weighted loss_sds was inf in step 0"


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_number_that_is_not_finite_is_named(value):
    bad = torch.zeros(5, 3)
    bad[4, 1] = value
    values = [("quats", torch.ones(5, 4)), ("means", bad)]
    refused("step 7: 1 of the 15 numbers of means are NaN", finite.require_finite, values, step=7)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        # the second is found at the end
        (["system.loss.lambda_sds=1e38", *length(5)], ("are NaN or infinite", "step 4:", INFINITE)),
        (["system.geometry.lr_scales=20", *length(3)], (".log_scales are beyond 30", "lr_*")),
    ],
)
def test_a_diverged_run_saves_nothing(tmp_path, painted_box, monkeypatch, capsys, options, said):
    monkeypatch.setattr(finite, "CHECK_EVERY", 4)
    assert launch(tmp_path, painted_box, *options, "system.pages=false") == 2
    errors = capsys.readouterr().err
    assert all(errors.count(words) == 1 for words in said)
    assert not [*tmp_path.rglob("*.ckpt"), *tmp_path.rglob("it*")]


def test_a_non_finite_state_never_replaces_a_good_checkpoint(tmp_path, painted_box, monkeypatch):
    step = system.GaussianDreamerSystem.training_step

    def with_nan(self, batch, batch_idx):
        step(self, batch, batch_idx)
        if self.global_step == 3:
            self.geometry.means.data[5, 1] = torch.nan

    monkeypatch.setattr(system.GaussianDreamerSystem, "training_step", with_nan)
    every = ["checkpoint.every_n_train_steps=1", "system.pages=false", *length(4)]
    assert launch(tmp_path, painted_box, *every) == 2
    last = run_folder(tmp_path) / "ckpts" / "last.ckpt"
    found = torch.load(last, weights_only=True)
    assert found["global_step"] == 2 and found["state_dict"]["geometry.means"].isfinite().all()


def test_a_cloud_that_is_not_finite_is_not_exported(tmp_path, painted_box, monkeypatch, capsys):
    ensure_cloud = system.GaussianDreamerSystem.ensure_cloud

    def with_nan(self):
        ensure_cloud(self)
        self.geometry.sh0.data[7] = torch.inf

    monkeypatch.setattr(system.GaussianDreamerSystem, "ensure_cloud", with_nan)
    assert launch(tmp_path, painted_box, stage="--export") == 2
    assert "3 of the 600 numbers of geometry.sh0 are NaN or infinite" in capsys.readouterr().err
    assert not list(tmp_path.rglob("it*"))


def test_invisible_numbers_states_of_optimisers_empty_renders_and_bad_losses_are_named(caplog):
    far = [("geometry.means", torch.tensor([[0, 0, -1e20], [0, 1, 2]]))]
    refused("1 of the 6 numbers of geometry.means are beyo", finite.require_finite, far, step=2)
    large = [("log_scales", torch.tensor([100.0, 0, 0]))]
    refused("3 numbers of log_scales are beyond 30", finite.require_finite, large, step=2)
    good = [("means.exp_avg", torch.tensor([3e38])), ("means", torch.zeros(0, 3))]
    finite.require_finite(good, step=2)
    finite.require_finite([], step=0)
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.Adam([{"params": [parameter], "name": "means"}])
    parameter.grad = torch.tensor([1.0, 1e30])
    optimizer.step()
    assert parameter.isfinite().all()
    state = finite.optimizer_tensors(optimizer)
    refused("1 of the 2 numbers of means.exp_avg_sq", finite.require_finite, state, step=1)
    for step, opacity in ((0, 1e-9), (1, 0.0), (0, 0.0)):
        assert not caplog.text
        finite.warn_if_invisible(torch.full((1, 4, 4, 1), opacity), step)
    assert "no Gaussian is visible in the first step's views" in caplog.text
    losses, good = [], torch.tensor(1.0)
    for step in range(5, 30):
        losses.append((step, {"sds": good, "tv": good * torch.nan if step in (9, 12) else good}))
    means = [("means", torch.full((2,), torch.nan))]
    said = "after the weighted loss_tv was nan in step 9:"
    refused(said, finite.require_finite, means, step=30, losses=losses)
    refused("means are NaN or infinite: the run stops", finite.require_finite, means, step=1)
