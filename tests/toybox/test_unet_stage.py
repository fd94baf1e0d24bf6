"""The training of the U-Net: its batches and its measurement; formulas of stages."""

import collections
import dataclasses

import numpy as np
import pytest
import torch

from tests.toybox.helpers import options
from threestudio_gaussiandreamer.toybox import points_stage, tokens, unet_stage, views, words
from threestudio_gaussiandreamer.toybox.clip_stage import NAMED_QUADRANT
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


def test_formulas():
    abar = torch.tensor([0.01, 0.5, 0.99], dtype=torch.float64)
    expected = torch.tensor([1, 1, 0.06], dtype=torch.float64)
    assert torch.allclose(unet_stage.truncated_weight(abar), expected)
    mean = 3 * torch.randn(50, 4, 16, 16, generator=torch.Generator().manual_seed(0))
    moments = torch.stack([mean, torch.full_like(mean, 4.0)])
    assert unet_stage.latent_scale(moments) == pytest.approx(1 / 5, rel=0.01)
    front = torch.tensor([[[0.8, 0, 0, 1.0, 0, 0]]])
    expected = torch.tensor([0, -1.0, 0, 1, -1, -1])  # Point-E's front is -y
    assert torch.allclose(points_stage.network_units(front)[0, :, 0], expected, atol=1e-6)


def test_prompts_that_name_a_quadrant():
    named = ("a fox, left side view", "right side view of a fox", "backside view of a fox")
    assert all(NAMED_QUADRANT.search(text) for text in (*named, "a fox, front view"))
    assert not any(map(NAMED_QUADRANT.search, ("a fox, side view", "a fox, overhead view", "a")))
