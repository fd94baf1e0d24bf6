"""The training of the U-Net: its measurement, and training a part of it."""

import collections
import dataclasses

import numpy as np
import pytest
import torch

from tests.toybox.helpers import copied, options, training
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.toybox import tokens, views, warm_start, words
from threestudio_gaussiandreamer.toybox.loop import averaged_weights
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


def test_most_batches_are_all_views_of_objects_at_one_timestep(folder):
    stage = STAGES["unet"](dataclasses.replace(options(folder), batch=2 * views.VIEWS))
    data = stage.data()
    assert [data[step].views for step in range(5)] == [1, 4, 4, 4, 1]
    batch = data[1]
    assert len(batch.latents) == len(batch.t) == len(batch.ids) == 8
    t = batch.t.reshape(2, views.VIEWS)
    assert (t == t[:, :1]).all() and t[0, 0] != t[1, 0]
    assert torch.equal(batch.noise, data[1].noise)


def test_joined_prompts_have_the_same_words_and_the_directions_of_their_pictures(folder):
    shard = STAGES["unet"](options(folder)).shards.get_light(0)
    objects, rng = np.array([2, 0, 3, 1] * 50), np.random.default_rng(0)
    texts = tokens.joined_prompts(shard, objects, views.VIEWS, rng)
    sorts = collections.Counter()
    for row, own in zip(objects, np.reshape(texts, (-1, views.VIEWS)).tolist(), strict=True):
        if own[0].endswith(" view"):
            rows = range(row * views.VIEWS, (row + 1) * views.VIEWS)
            names = [words.direction(shard.elevation[r], shard.azimuth[r]) for r in rows]
            [text] = {text.rpartition(",")[0] for text in own}
            assert own == [f"{text}, {name} view" for name in names]
            sorts["direction"] += 1
        else:
            assert len(set(own)) == 1
            sorts["empty" if own[0] == "" else "plain"] += 1
    assert sorts["direction"] > 140 and sorts["empty"] > 5 and sorts["plain"] > 0


def test_only_named_parameters_are_trained(folder, tmp_path):
    place = copied(folder, tmp_path / "run")
    training(place, "unet").run(4)
    before = averaged_weights(place, "unet")
    run = training(place, "unet", only="attentions")
    run.run(run.progress.images + 4)
    after = averaged_weights(place, "unet")
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
