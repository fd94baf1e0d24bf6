"""Checkpoints with a valid checksum and impossible content give one message before any work."""

import copy
import math
from collections.abc import Callable
from typing import Any

import pytest
import torch

from threestudio_gaussiandreamer.core.checkpoint_file import load_checkpoint, save_file
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.training_state import check_training_state
from threestudio_gaussiandreamer.training.system import GaussianDreamerSystem


@pytest.fixture
def whole(gallery) -> dict[str, Any]:
    """Return a copy of the content of the last checkpoint of a finished run."""
    return copy.deepcopy(load_checkpoint(gallery("trained") / "ckpts" / "last.ckpt"))


def read(path: Any, content: dict, optimizer: str = "Adam") -> dict:
    """Write, read and check, as a resumed run does."""
    save_file(path, content)
    checkpoint = load_checkpoint(path)
    GaussianDreamerSystem.check_checkpoint(checkpoint, str(path))
    check_training_state(checkpoint, {"name": optimizer}, str(path))
    return checkpoint


def at(*keys: Any, value: Any) -> Callable[[dict], None]:
    """Replace the value under these keys; if ``value`` is a function, by its result."""

    def change(content: dict) -> None:
        *path, last = keys
        for key in path:
            content = content[key]
        content[last] = value(content[last]) if callable(value) else value

    return change


def without(*keys: Any) -> Callable[[dict], None]:
    def change(content: dict) -> None:
        *path, last = keys
        for key in path:
            content = content[key]
        del content[last]

    return change


def empty_cloud(content: dict) -> None:
    state = content["state_dict"]
    cloud = {key: value for key, value in state.items() if key.startswith("geometry.")}
    state |= {key: value[:0] for key, value in cloud.items() if value.dim()}


MEANS, ADAM = ("state_dict", "geometry.means"), ("optimizer_states", 0)
FIT = ("loops", "fit_loop")
NAN = lambda tensor: tensor * math.nan  # noqa: E731
IMPOSSIBLE = [
    (at("state_dict", value=[1]), "its state_dict is of type list"),
    (at("global_step", value=None), "its global_step is of type NoneType"),
    (at("loops", value={"x": 1}), "its loops aren't those of Lightning: KeyError"),
    (empty_cloud, "holds no Gaussian"),
    (at(*MEANS, value=NAN), r"geometry.means holds \d+ numbers that are NaN"),
    (at(*MEANS, value=torch.Tensor.long), "is of the type torch.int64"),
    (at(*MEANS, value=[1.0]), "in its state_dict is of type list"),
    (at("state_dict", "geometry.quats", value=lambda t: t[:4]), "has the shape .4, 4.; expected"),
    (at("state_dict", 3, value=torch.zeros(1)), "3 in its state_dict is of type Tensor"),
    (at("global_step", value=-1), "its global_step is -1"),
    (at("global_step", value=10**400), "its global_step is an integer of 1329 bits"),
    (at("global_step", value=777), r"loops are at step \d, its global_step is 777"),
    (at("epoch", value=-1), "its epoch is -1"),
    (at("epoch", value="0"), "its epoch is of type str"),
    (at("loops", value=[1]), "its loops aren't those of Lightning: TypeError"),
    (at(*FIT, value={}), "its loops are at step 0"),
    (
        at(*FIT, "epoch_loop.manual_optimization.optim_step_progress", value={}),
        "its loops aren't those of Lightning: KeyError",
    ),
    (at("optimizer_states", value=[]), "Adam can't resume .*: ValueError there is no optimiser"),
    (at("optimizer_states", value=[None]), "Adam can't resume"),
    (at(*ADAM, "param_groups", value=[]), "Adam can't resume"),
    (at(*ADAM, "param_groups", 0, "betas", value="x"), "Adam can't resume"),
    (at(*ADAM, "state", 0, "exp_avg", value=lambda t: t[:3]), "Adam can't resume"),
    (at(*ADAM, "state", 0, "exp_avg_sq", value=NAN), "means.* is NaN"),
    (at(*ADAM, "state", 0, "exp_avg_sq", value=lambda t: t - 1), "means.* is NaN"),
    (without(*ADAM, "state", 0, "step"), "Adam can't resume from its optimizer_states, which may"),
    (at("pytorch-lightning_version", value="x"), "is 'x'; expected 2.0 or later"),
    (at("pytorch-lightning_version", value="1.9.5"), "is '1.9.5'; expected 2.0 or later"),
]


@pytest.mark.parametrize(("change", "message"), IMPOSSIBLE, ids=[m for _, m in IMPOSSIBLE])
def test_impossible_content_is_refused_in_one_message(tmp_path, whole, change, message):
    change(whole)
    with pytest.raises(UserError, match=message):
        read(tmp_path / "a.ckpt", whole)


def test_a_whole_checkpoint_is_accepted(tmp_path, whole):
    read(tmp_path / "a.ckpt", whole)
    later = whole | {"pytorch-lightning_version": "10.0.1"}
    read(tmp_path / "c.ckpt", later)

    plain = copy.deepcopy(whole)
    state = plain["optimizer_states"][0]
    optimizer = torch.optim.SGD([torch.zeros(1, requires_grad=True)], lr=0.1)
    (own,) = optimizer.state_dict()["param_groups"]
    kept = [{name: group[name] for name in ("params", "name")} for group in state["param_groups"]]
    state |= {"state": {}, "param_groups": [own | group for group in kept]}
    read(tmp_path / "d.ckpt", plain, "SGD")
