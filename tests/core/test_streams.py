"""Draws are a function of (seed, stream, step, item) only."""

import itertools

import torch

from threestudio_gaussiandreamer.core import streams


def test_the_same_key_gives_the_same_draw_after_any_other_draws():
    first = torch.rand(4, generator=streams.generator(1, "camera", 7))
    torch.rand(100)
    torch.manual_seed(5)
    assert torch.equal(first, torch.rand(4, generator=streams.generator(1, "camera", 7)))
    one, again = (streams.numpy_generator(1, "grow").random(3) for _ in range(2))
    assert (one == again).all()


def test_any_other_key_gives_another_draw():
    keys = list(itertools.product((0, 1), ("camera", "noise"), (0, 1, 11), (0, 1)))
    assert len({streams.derive_seed(*key) for key in keys}) == len(keys)
    assert streams.derive_seed(0, "a", 1, 11) != streams.derive_seed(0, "a", 11, 1)


def test_the_noise_of_an_item_does_not_depend_on_the_batch():
    four = streams.normal_per_item((4, 2, 3), 0, "noise", 9)
    assert torch.equal(streams.normal_per_item((2, 2, 3), 0, "noise", 9), four[:2])
    assert streams.normal_per_item((0, 2), 0, "noise", 9).shape == (0, 2)
    many = streams.normal_per_item((8, 1000), 0, "noise", 0)
    assert abs(float(many.std()) - 1) < 0.05  # 8000 draws: 6 standard errors
