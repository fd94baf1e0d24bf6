"""Damaged files, and those that a run can't go on from, give one message before any work."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from tests.launch.cases import assert_refused
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.densify import Change
from threestudio_gaussiandreamer.images import read as read_image
from threestudio_gaussiandreamer.launch.run import check_optimizer, lightning_errors
from threestudio_gaussiandreamer.training import held_out as evaluate
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem

register_parts()
TRIAL = Path("outputs/demo/t")


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


def test_an_invalid_mesh_is_refused(launch_demo):
    Path("text.glb").write_bytes(b"hello there, this is no mesh")
    assert_refused(*launch_demo("system.guidance.mesh=text.glb"), "text.glb")


def test_damaged_results_of_an_earlier_run_are_made_again(tmp_path):
    for content in (b"{bro", b"\xff", b"[1]"):
        (tmp_path / "metrics.json").write_bytes(content)
        assert evaluate.Measurements(None, tmp_path).values == {}
    (tmp_path / "held_out").mkdir()
    for content in (b"", b"\x89PNG\r\n\x1a\nxx"):
        (tmp_path / "held_out/prior.png").write_bytes(content)
        images = torch.rand(6, 4, 4, 3)
        evaluate.Measurements(None, tmp_path)._save_pictures("result", images, images)
        assert read_image(tmp_path / "held_out/compare.png").shape == (8, 24, 3)


def test_what_a_finished_run_can_be_resumed_with(launch_demo):
    """At its end it is measured, also where the scores are missing, as in another folder."""
    assert launch_demo("checkpoint.save_weights_only=true")[0] == 0
    last = f"resume={TRIAL}/ckpts/last.ckpt"
    code, err = launch_demo(last, "tag=other")
    assert code == 0 and "nothing is left to train" in err
    folders = TRIAL, TRIAL.with_name("other")
    scores = (json.loads((folder / "save/metrics.json").read_text()) for folder in folders)
    first, other = (score["result"] for score in scores)
    assert (other["step"], other["psnr"]) == (first["step"], first["psnr"])
    assert "optimizer_states" in load_checkpoint(TRIAL / "ckpts/last.ckpt")
    (weights,) = (path for path in (TRIAL / "ckpts").iterdir() if path.name != "last.ckpt")
    code, err = launch_demo(f"resume={weights}", "trainer.max_steps=3")
    message = "has no optimizer_states, which Lightning writes unless checkpoint.save_weights_only"
    assert code == 2 and message in err
    code, err = launch_demo(last, "system.optimizer.name=SGD", "trainer.max_steps=3")
    assert "is of another run: system.optimizer.name was 'Adam', now it is 'SGD'" in err
    assert code == 2 and "SGD can't resume from its optimizer_states, which may be another" in err
