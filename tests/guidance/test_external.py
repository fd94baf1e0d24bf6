"""Guidances of other packages by name, with threestudio's signatures."""

import pytest
import torch
from torch import nn

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.guidance import external
from threestudio_gaussiandreamer.host import BaseModule, register


class ImageDouble:
    """The signature of threestudio's zero123, which takes no prompt."""

    def __call__(
        self, rgb, elevation, azimuth, camera_distances,
        rgb_as_latents=False, guidance_eval=False, **kwargs,
    ):  # fmt: skip
        return {"loss_sds": rgb.sum() + elevation.sum(), "kwargs": kwargs}


def strict(rgb, prompt_utils, elevation, azimuth, camera_distances):
    """Takes three entries of the batch and nothing else."""
    return {"loss_sds": rgb.sum(), "prompt": prompt_utils}


def other_name(rgb, prompt, elevation, azimuth, camera_distances, **kwargs):
    """Uses another name for the prompt, which threestudio passes by position."""
    return {"loss_sds": rgb.sum(), "prompt": prompt}


def wrapped(*args, **kwargs):
    """Passes all arguments on, so that its signature is uninformative."""
    return other_name(*args, **{"prompt": kwargs.pop("prompt_utils"), **kwargs})


def part(call):
    return type("Double", (), {"__call__": staticmethod(call)})()


class LearningDouble(nn.Module):
    """Like VSD: a module with frozen and trainable weights, and a loss for the latter."""

    def __init__(self):
        super().__init__()
        self.frozen = nn.Linear(3, 3).requires_grad_(False)
        self.lora = nn.Linear(3, 3, bias=False)

    def forward(
        self, rgb, prompt_utils, elevation, azimuth, camera_distances,
        mvp_mtx, c2w, rgb_as_latents=False, **kwargs,
    ):  # fmt: skip
        return {
            "loss_vsd": rgb.sum(),
            "loss_lora": (self.lora(rgb.detach()) - self.frozen(rgb.detach())).square().mean(),
        }


@register("test-learning-guidance")
class LearningPart(BaseModule):
    """Like VSD's: its initial weights and its noise come from torch's global generator."""

    def configure(self):
        self.learner = LearningDouble()

    def forward(self, rgb, prompt_utils, **batch):
        noisy = rgb + 0.1 * torch.randn_like(rgb)
        return self.learner(noisy, prompt_utils, **batch)


def batch():
    angles = dict.fromkeys(("elevation", "azimuth", "camera_distances"), torch.ones(2))
    matrices = dict.fromkeys(("c2w", "mvp_mtx"), torch.eye(4).expand(2, -1, -1))
    return angles | matrices | {"height": 4, "width": 4}


def test_each_signature_gets_what_it_takes():
    rgb = torch.rand(2, 4, 4, 3)
    options = {"rgb_as_latents": False, "comp_rgb_bg": torch.zeros(2, 1, 1, 3)}

    def called(double):
        return external.call_guidance(double, rgb, "prompts", batch(), **options)

    others = {"height", "width", "c2w", "mvp_mtx", "comp_rgb_bg", "prompt_utils"}
    assert set(called(ImageDouble())["kwargs"]) == others
    for double in (strict, other_name, wrapped):
        assert called(part(double))["prompt"] == "prompts"
    assert set(called(LearningDouble())) == {"loss_vsd", "loss_lora"}


@pytest.mark.parametrize(
    "returned, message",
    [
        (torch.zeros(3), "returned Tensor"),
        ({"loss_sds": torch.zeros(4)}, r"returned loss_sds of .*\(\[4\]\): expected one number"),
        ({"loss_x": None}, "returned loss_x of NoneType: expected one"),
        ({"loss_x": {"a": 1}}, "returned loss_x of dict: expected one"),
        ({"loss_x": [torch.zeros(2)]}, "returned loss_x of list: expected one"),
        ({"loss_sds": torch.tensor(torch.nan)}, "returned loss_sds = nan: expected a finite"),
        ({"loss_sds": torch.inf}, "returned loss_sds = inf"),
        ({"loss_sds": torch.ones(()), "loss_off": 0.0, "note": 1.5}, None),
    ],
)
def test_content_that_no_run_can_use_is_named(returned, message):
    inputs = part(lambda rgb: returned), torch.zeros(1, 2, 2, 3), None, {}
    if message is None:  # a loss that is off may be a plain number
        out = external.call_guidance(*inputs)
        assert torch.stack([out["loss_sds"], out["loss_off"]]).tolist() == [1, 0]
        return
    with pytest.raises(UserError, match=f"Double {message}"):
        external.call_guidance(*inputs)


def test_what_a_guidance_learnt_is_put_back_and_its_draws_are_functions_of_the_step():
    guidance, other = LearningDouble(), LearningDouble()
    assert external.trainable_groups(ImageDouble(), 1e-3) == []
    (group,) = external.trainable_groups(guidance, 1e-3)
    assert (group["name"], group["lr"]) == ("guidance", 1e-3)
    assert [id(parameter) for parameter in group["params"]] == [id(guidance.lora.weight)]
    weights = external.learnt_weights(guidance)
    assert list(weights) == ["lora.weight"] and not weights["lora.weight"].requires_grad
    external.restore_learnt(other, weights)
    assert torch.equal(other.lora.weight, guidance.lora.weight) and other.lora.weight.requires_grad
    assert external.learnt_weights(ImageDouble()) == {}
    external.restore_learnt(ImageDouble(), {})
    with pytest.raises(UserError, match="had learnt 1 tensors, and ImageDouble learns 0"):
        external.restore_learnt(ImageDouble(), weights)

    def draw(step):
        with external.own_randomness(step):
            return torch.rand(3)

    torch.manual_seed(5)
    first, other = draw(1), draw(2)
    after = torch.rand(3)
    torch.manual_seed(5)
    assert torch.equal(torch.rand(3), after)
    assert torch.equal(draw(1), first) and not torch.equal(first, other)
