"""Parameters and optimiser state that aren't finite are found and named."""

import pytest
import torch

from tests.training.runs import launch, length, run_folder
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.training import finite
from threestudio_gaussiandreamer.training.finite import (
    optimizer_tensors,
    require_finite,
    warn_if_invisible,
)
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_number_that_is_not_finite_is_named(value):
    bad = torch.zeros(5, 3)
    bad[4, 1] = value
    with pytest.raises(UserError, match=r"step 7: 1 of the 15 numbers of means are NaN"):
        require_finite([("quats", torch.ones(5, 4)), ("means", bad)], step=7)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            ["system.loss.lambda_sds=1e38", *length(5)],
            ("are NaN or infinite", "step 4:", "after the weighted loss_sds was inf in step 0"),
        ),  # the second is found at the end
        (["system.geometry.lr_scales=20", *length(3)], (".log_scales are beyond 30", "lr_*")),
    ],
)
def test_a_run_that_turns_non_finite_stops_and_saves_nothing_of_it(
    tmp_path, painted_box, monkeypatch, capsys, options, said
):
    monkeypatch.setattr(finite, "CHECK_EVERY", 4)
    assert launch(tmp_path, painted_box, *options, "system.pages=false") == 2
    errors = capsys.readouterr().err
    assert all(errors.count(words) == 1 for words in said)
    assert not [*tmp_path.rglob("*.ckpt"), *tmp_path.rglob("it*")]


def test_a_non_finite_state_never_replaces_a_good_checkpoint(tmp_path, painted_box, monkeypatch):
    step = GaussianDreamerSystem.training_step

    def with_nan(self, batch, batch_idx):
        step(self, batch, batch_idx)
        if self.global_step == 3:
            self.geometry.means.data[5, 1] = torch.nan

    monkeypatch.setattr(GaussianDreamerSystem, "training_step", with_nan)
    every = ["checkpoint.every_n_train_steps=1", "system.pages=false", *length(4)]
    assert launch(tmp_path, painted_box, *every) == 2
    last = run_folder(tmp_path) / "ckpts" / "last.ckpt"
    found = torch.load(last, weights_only=True)
    assert found["global_step"] == 2 and found["state_dict"]["geometry.means"].isfinite().all()


def test_a_cloud_that_is_not_finite_is_not_exported(tmp_path, painted_box, monkeypatch, capsys):
    ensure_cloud = GaussianDreamerSystem.ensure_cloud

    def with_nan(self):
        ensure_cloud(self)
        self.geometry.sh0.data[7] = torch.inf

    monkeypatch.setattr(GaussianDreamerSystem, "ensure_cloud", with_nan)
    assert launch(tmp_path, painted_box, stage="--export") == 2
    assert "3 of the 600 numbers of geometry.sh0 are NaN or infinite" in capsys.readouterr().err
    assert not list(tmp_path.rglob("it*"))


def test_invisible_numbers_states_of_optimisers_empty_renders_and_bad_losses_are_named(caplog):
    with pytest.raises(UserError, match=r"1 of the 6 numbers of geometry.means are beyo"):
        require_finite([("geometry.means", torch.tensor([[0, 0, -1e20], [0, 1, 2]]))], step=2)
    with pytest.raises(UserError, match="3 numbers of log_scales are beyond 30"):
        require_finite([("log_scales", torch.tensor([100.0, 0, 0]))], step=2)
    require_finite([("means.exp_avg", torch.tensor([3e38])), ("means", torch.zeros(0, 3))], step=2)
    require_finite([], step=0)
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.Adam([{"params": [parameter], "name": "means"}])
    parameter.grad = torch.tensor([1.0, 1e30])
    optimizer.step()
    assert parameter.isfinite().all()
    with pytest.raises(UserError, match="1 of the 2 numbers of means.exp_avg_sq"):
        require_finite(optimizer_tensors(optimizer), step=1)
    for step, opacity in ((0, 1e-9), (1, 0.0), (0, 0.0)):
        assert not caplog.text
        warn_if_invisible(torch.full((1, 4, 4, 1), opacity), step)
    assert "no Gaussian is visible in the first step's views" in caplog.text
    losses, good = [], torch.tensor(1.0)
    for step in range(5, 30):
        losses.append((step, {"sds": good, "tv": good * torch.nan if step in (9, 12) else good}))
    means = [("means", torch.full((2,), torch.nan))]
    with pytest.raises(UserError, match="after the weighted loss_tv was nan in step 9:"):
        require_finite(means, step=30, losses=losses)
    with pytest.raises(UserError, match="means are NaN or infinite: the run stops"):
        require_finite(means, step=1)
