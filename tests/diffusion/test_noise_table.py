"""Noise from a table: standard normal, a function of (seed, stream, step, item)."""

import pytest
import torch

from threestudio_gaussiandreamer.diffusion.noise_table import SLICES, NoiseTable


@pytest.fixture(scope="module")
def table():
    return NoiseTable(0, 10_000)


def test_draws_are_standard_normal_and_uncorrelated(table):
    draws = [table.draw((100, 100), "a", step, range(3)) for step in range(4)]
    noise = torch.stack([item.flatten() for draw in draws for item in draw])
    assert noise.shape == (12, 10_000)
    # five deviations of a mean, a variance and a correlation
    assert noise.mean(1).abs().max() < 0.05 and (noise.var(1) - 1).abs().max() < 0.08
    correlation = torch.corrcoef(noise) - torch.eye(12)
    assert correlation.abs().max() < 0.05


def test_an_items_draw_depends_on_seed_stream_and_step_alone(table):
    first = table.draw((5, 4), "a", 1, [0, 2])
    table.draw((3,), "b", 7, [1])
    assert torch.equal(table.draw((5, 4), "a", 1, [2])[0], first[1])
    assert torch.equal(NoiseTable(0, 10_000).draw((5, 4), "a", 1, [2])[0], first[1])
    for other in (
        table.draw((5, 4), "b", 1, [0]),
        table.draw((5, 4), "a", 2, [0]),
        table.draw((5, 4), "a", 1, [1]),
        NoiseTable(1, 10_000).draw((5, 4), "a", 1, [0]),
    ):
        assert not torch.equal(other[0], first[0])


def test_items_of_any_size_have_numbers_of_their_own():
    large = NoiseTable(0, 2**19)
    draws = large.draw((2**19,), "a", 3, range(SLICES - 1))
    assert len(draws) == 15 and len({float(draw[0]) for draw in draws}) == 15
