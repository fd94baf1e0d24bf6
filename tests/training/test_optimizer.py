"""Learning rates of other packages' parts, and arguments of the optimiser."""

from types import SimpleNamespace

import pytest
import torch

from tests.helpers.refusals import refused
from tests.training.runs import CONFIGS, SMALL, mocked_config, run_folder
from threestudio_gaussiandreamer import register_parts
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.launch.config import load_config
from threestudio_gaussiandreamer.launch.experiment import main
from threestudio_gaussiandreamer.training.background import FlatBackground
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.optimizer import PARTS, PartRates, check_optimizer

COLOR = "background.env_color"


def checkpoint(folder):
    return torch.load(run_folder(folder) / "ckpts" / "last.ckpt", weights_only=False)


@pytest.fixture
def train(tmp_path, painted_box):
    """Return a function that trains towards (0.9, 0.2, 0.1) on a learned background of the host."""
    background = {"background_type": "solid-color-background", "background": {"learned": True}}
    config = mocked_config(tmp_path, painted_box, **background)

    def trained(folder, *options):
        overrides = [f"exp_root_dir={folder}", *SMALL, "system.pages=false", *options]
        return main(["--config", str(config), "--train", "--gpu", "cpu", *overrides])

    return trained


def test_the_colour_of_another_background_is_learned_and_resumed(train, tmp_path):
    rate = "system.optimizer.params.background.lr=[0,0.02,0.05,4]"
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    assert train(whole, rate, "trainer.max_steps=4") == 0
    assert train(parts, rate, "trainer.max_steps=2") == 0
    last = run_folder(parts) / "ckpts" / "last.ckpt"
    assert train(parts, rate, "trainer.max_steps=4", f"resume={last}") == 0
    color = checkpoint(whole)["state_dict"][COLOR]
    assert torch.equal(checkpoint(parts)["state_dict"][COLOR], color)
    assert (color[1:] < 0.9).all()  # it was white
    groups = checkpoint(whole)["optimizer_states"][0]["param_groups"]
    rates = {group["name"]: group["lr"] for group in groups}
    assert rates["background.parameters"] == pytest.approx(0.0425)  # that of step 3


def test_parameters_need_a_rate_and_changed_arguments_hold_on_resume(train, tmp_path, capsys):
    assert train(tmp_path, "system.geometry.prior.path=missing.glb") == 2
    said = capsys.readouterr().err
    assert "SolidColorBackground has parameters without" in said and "params.background.lr" in said
    options = ["system.optimizer.params.background.lr=0", "system.optimizer.name=AdamW"]
    decay = "system.optimizer.args.weight_decay"
    assert train(tmp_path, *options, f"{decay}=0.01", "trainer.max_steps=1") == 0
    assert (checkpoint(tmp_path)["state_dict"][COLOR] == 1).all()
    last = run_folder(tmp_path) / "ckpts" / "last.ckpt"
    changed = [f"{decay}=0.5", "system.optimizer.args.betas=[0.5,0.9]", f"resume={last}"]
    assert train(tmp_path, *options, *changed, "trainer.max_steps=2") == 0
    for group in checkpoint(tmp_path)["optimizer_states"][0]["param_groups"]:
        assert group["weight_decay"] == 0.5 and list(group["betas"]) == [0.5, 0.9]


def groups(geometry, params=(), **parts):
    parts = dict.fromkeys(PARTS) | parts | {"geometry": geometry}
    return PartRates({"params": dict(params)}).groups(SimpleNamespace(**parts))


@pytest.mark.parametrize(
    ("name", "part", "said"),
    [("background", FlatBackground({}), ": its rate is system.back"), ("material", None, "$")],
)
def test_a_rate_without_parameters_is_refused(name, part, said):
    with pytest.raises(UserError, match=f"params.{name}: .* that need this rate{said}"):
        groups(GaussianCloud({}), {name: {"lr": 0.1}}, **{name: part})


@pytest.mark.parametrize(
    ("params", "message"),
    [
        (3, "optimizer.params: expected parts and their lr, got 3"),
        ({"backgroud": {"lr": 1}}, "did you mean 'background'"),
        ({"geometry": {"lr": 1}}, "its rates are system.geometry.lr_\*"),
        ({"background": 0.1}, r"params.background: expected \{lr: ...\}, got 0.1"),
        ({"background": {"lr": -1}}, "params.background.lr: expected values of 0 or more"),
        ({"background": {"lr": 1, "eps": 1}}, r"expected \{lr: ...\}"),
    ],
)
def test_wrong_rates_are_named(params, message):
    refused(message, check_optimizer, {"name": "Adam", "params": params})


@pytest.mark.parametrize("name", ["SGD", "Adafactor", "ASGD"])
def test_another_optimiser_forgets_the_arguments_that_it_lacks(name):
    register_parts()
    config = CONFIGS / "gaussiandreamer.yaml"
    prompt = "system.prompt_processor.prompt=a fox"
    cfg = load_config(config, cli_args=[prompt, f"system.optimizer.name={name}"])
    check_optimizer(cfg.system.optimizer)
    assert "betas" not in cfg.system.optimizer.args
    nothing = load_config(config, cli_args=[prompt, "system.optimizer.args=null"])
    check_optimizer(nothing.system.optimizer)


def test_only_optimisers_that_can_train_are_named_and_no_parameter_is_left_untrained():
    with pytest.raises(UserError) as error:
        check_optimizer({"name": "zz"})
    named = str(error.value).partition("choose from ")[2].rstrip(".").split(", ")
    assert {"Adam", "SGD", "RMSprop"} <= set(named)
    for name in named:
        check_optimizer({"name": name})
    assert not {"Optimizer", "LBFGS", "SparseAdam", "Muon"} & set(named)

    class Own(GaussianCloud):
        def configure(self):
            super().configure()
            self.bright = torch.nn.Parameter(torch.zeros(1))

    class Grouped(Own):
        def parameter_groups(self):
            own = {"name": "bright", "lr": 0.1, "params": [self.bright]}
            return [*super().parameter_groups(), own]

    refused("Own has the parameter bright without a learning rate", groups, Own({}))
    assert groups(Grouped({})) == []
