"""Whole files with content that a run can't go on from give one message before any work."""

import math

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.densify import Change
from threestudio_gaussiandreamer.launch.run import check_optimizer, lightning_errors
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


@pytest.fixture
def cloud():
    shapes = {"means": (3,), "log_scales": (3,), "quats": (4,), "logit_opacities": (), "sh": (1, 3)}
    geometry = GaussianCloud({})
    geometry.set_arrays(**{name: np.ones((10, *shape), "f") for name, shape in shapes.items()})
    return geometry


@pytest.mark.parametrize(
    ("name", "change", "message"),
    [
        ("means", lambda tensor: tensor, None),
        ("means", lambda tensor: tensor[:0], "holds no Gaussian"),
        ("means", lambda tensor: tensor * math.nan, "geometry.means holds 30 numbers that are NaN"),
        ("means", torch.Tensor.long, "is of the type torch.int64"),
        ("quats", lambda tensor: tensor[:4], "has the shape .4, 4.; expected"),
    ],
)
def test_an_impossible_cloud_is_refused(cloud, name, change, message):
    state = {f"geometry.{key}": value for key, value in cloud.state_dict().items()}
    if message == "holds no Gaussian":
        state = {key: value[:0] if value.dim() else value for key, value in state.items()}
    state[f"geometry.{name}"] = change(state[f"geometry.{name}"])
    if message is None:
        return GaussianDreamerSystem.check_checkpoint({"state_dict": state}, "a.ckpt")
    with pytest.raises(UserError, match=f"a.ckpt.*{message}"):
        GaussianDreamerSystem.check_checkpoint({"state_dict": state}, "a.ckpt")


@pytest.mark.parametrize(
    ("parents", "names", "message"),
    [
        ([], None, "leaves no Gaussian"),
        ([3], ["means"], r"has the shapes {'means': \(1, 3\)}; expected"),
        ([10], None, "parents of the change of the cloud: expected 1 integers from 0 to 9"),
    ],
)
def test_an_impossible_change_of_the_cloud_is_refused(cloud, parents, names, message):
    stored = cloud.parameters_by_name()
    values = {name: stored[name].detach()[: len(parents)] for name in names or stored}
    rows = torch.tensor(parents, dtype=torch.long)
    with pytest.raises(UserError, match=message):
        cloud.apply_change(Change(rows, rows < 0, values), None)


def test_the_state_of_another_optimiser_is_refused(cloud):
    optimizer = torch.optim.Adam(cloud.parameter_groups(), lr=1e-3)
    for _ in range(2):  # without and with moments
        check_optimizer("Adam", [optimizer.state_dict()], "a.ckpt")
        with pytest.raises(UserError, match="a.ckpt: SGD can't resume from its optimizer_states"):
            check_optimizer("SGD", [optimizer.state_dict()], "a.ckpt")
        for group in optimizer.param_groups:
            for parameter in group["params"]:
                parameter.grad = torch.ones_like(parameter)
        optimizer.step()
    with pytest.raises(UserError, match="Adamax can't resume .*: KeyError 'exp_inf'"):
        check_optimizer("Adamax", [optimizer.state_dict()], "a.ckpt")
    for kind in (torch.optim.SGD, torch.optim.Adafactor):
        plain = kind(cloud.parameter_groups(), lr=1e-3)
        plain.step()
        check_optimizer(kind.__name__, [plain.state_dict()], "a.ckpt")
    for damaged in ([], [None], [{"param_groups": [{"params": [0]}], "state": {}}]):
        with pytest.raises(UserError, match="Adam can't resume"):
            check_optimizer("Adam", damaged, "a.ckpt")


def test_torchs_words_about_other_parameters_are_one_line():
    with pytest.raises(UserError) as error, lightning_errors("last.ckpt"):
        torch.nn.Linear(2, 3).load_state_dict({"tint": torch.ones(3)})
    assert "last.ckpt was made by another configuration: " in str(error.value)
    assert 'Unexpected key(s) in state_dict: "tint"' in str(error.value)
    assert "\n" not in str(error.value)
