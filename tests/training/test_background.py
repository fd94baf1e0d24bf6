"""Fixed, random and learned backgrounds."""

from types import SimpleNamespace

import pytest
import torch

from threestudio_gaussiandreamer.training.background import FlatBackground
from threestudio_gaussiandreamer.training.geometry import GaussianCloud
from threestudio_gaussiandreamer.training.optimizer import PartRates


def test_fixed_is_the_colour_in_training_and_evaluation():
    background = FlatBackground({"color": [0.2, 0.4, 0.6]})
    assert torch.allclose(background.color(3), torch.tensor([0.2, 0.4, 0.6]).expand(3, 3))
    assert background(torch.zeros(2, 5, 7, 3)).shape == (2, 5, 7, 3)
    assert not list(background.parameters())


def test_random_depends_on_the_step_alone_and_rests_in_evaluation():
    background = FlatBackground({"mode": "random", "color": [1.0, 1.0, 1.0]})
    background.update_step(0, 7)
    first = background.color(4)
    background.color(2)
    assert torch.equal(background.color(4), first) and len(first.unique(dim=0)) == 4
    background.update_step(0, 8)
    assert not torch.equal(background.color(4), first)
    assert torch.equal(background.eval().color(4), torch.ones(4, 3))


def test_learned_starts_at_the_colour_stays_in_range_and_learns():
    background = FlatBackground(
        {"mode": "learned", "color": [0.5, 0.5, 0.5], "lr": [0, 0.1, 0.2, 10]}
    )
    optimizer = torch.optim.Adam(background.parameter_groups())
    rates, cloud = PartRates({}), GaussianCloud({})
    rates.groups(
        SimpleNamespace(geometry=cloud, background=background, material=None, renderer=None)
    )
    for step in range(400):
        rates.set(optimizer, 0, step)
        optimizer.zero_grad()
        ((background.color(2) - torch.tensor([1.0, 0.0, 0.5])) ** 2).sum().backward()
        optimizer.step()
    assert optimizer.param_groups[0]["lr"] == pytest.approx(0.2)
    color = background.color(1)[0]
    assert color[0] > 0.95 and color[1] < 0.05 and color.min() >= 0 and color.max() <= 1


def test_a_derived_background_with_colours_of_pixels_is_drawn():
    class Derived(FlatBackground):
        pass

    class Gradient(FlatBackground):
        def forward(self, dirs):
            return dirs.abs()

    assert FlatBackground.is_flat(Derived({})) and not FlatBackground.is_flat(Gradient({}))
