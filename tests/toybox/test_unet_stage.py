"""The training of the U-Net: its measurement, and training a part of it."""

import pytest
import torch

from tests.toybox.helpers import copied, options, training
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import loop, warm_start, words
from threestudio_gaussiandreamer.toybox.train import STAGES

pytestmark = pytest.mark.usefixtures("small_world")


def test_the_unet_is_measured_with_the_prompts_of_opposite_views(folder):
    stage = STAGES["unet"](options(folder))
    (_, own), (_, opposite) = stage.held_out
    assert all(torch.equal(a, b) for a, b in zip(own[:3], opposite[:3], strict=True))
    texts = [stage.tokenizer.batch_decode(b.ids, skip_special_tokens=True) for b in (own, opposite)]
    for text, other in zip(*texts, strict=True):
        direction = next(name for name in words.OPPOSITE if f"{name} view" in text)
        assert other == text.replace(f"{direction} view", f"{words.OPPOSITE[direction]} view")
    assert not torch.equal(own.ids, opposite.ids)


def test_only_named_parameters_are_trained(folder, tmp_path):
    place = copied(folder, tmp_path / "run")
    training(place, "unet").run(4)
    before = loop.averaged_weights(place, "unet")
    run = training(place, "unet", only="attentions")
    run.run(run.progress.images + 4)
    after = loop.averaged_weights(place, "unet")
    changed = {key for key in before if not torch.equal(before[key], after[key])}
    assert changed and all("attentions" in key for key in changed)
    with pytest.raises(UserError, match="--only 'attention_layers'.*down_blocks"):
        training(place, "unet", only="attention_layers")


def test_the_rate_is_that_of_the_option(folder, tmp_path):
    run = training(copied(folder, tmp_path / "run"), "unet", rate=3e-3)
    run.progress.step = 1000
    run.train_step(next(run.stage.batches(0)))
    assert run.optimizer.param_groups[0]["lr"] == pytest.approx(3e-3)


def test_a_part_of_one_network_is_trained_on_from_weights(exported, tmp_path):
    warm_start.start_from(exported, options(tmp_path, only="attentions"), STAGES)
    run = training(tmp_path, "unet", only="attentions")
    free = {name for name, value in run.model.named_parameters() if value.requires_grad}
    assert free and all("attentions" in name for name in free)
