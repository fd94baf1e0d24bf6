"""Noise from a table: standard normal, a function of (seed, stream, step, part, item)."""

import pytest
import torch

from threestudio_gaussiandreamer.diffusion import inversion as noise_table
from threestudio_gaussiandreamer.diffusion.inversion import SLICES, NoiseTable


@pytest.fixture(scope="module")
def table():
    return NoiseTable(0, (100, 100))


def test_draws_are_standard_normal_and_uncorrelated(table):
    draws = [table.draw("a", step, 0, 3, part) for step in range(2) for part in range(2)]
    noise = torch.cat(draws).flatten(1)
    assert noise.shape == (12, 10_000)
    # five deviations of a mean, a variance and a correlation
    assert noise.mean(1).abs().max() < 0.05 and (noise.var(1) - 1).abs().max() < 0.08
    correlation = torch.corrcoef(noise) - torch.eye(12)
    assert correlation.abs().max() < 0.05


def test_an_items_draw_depends_on_seed_stream_step_and_part_alone(table):
    first = table.draw("a", 1, 0, 3)
    table.draw("b", 7, 1, 1)
    assert torch.equal(table.draw("a", 1, 2, 1)[0], first[2])
    assert torch.equal(NoiseTable(0, (100, 100)).draw("a", 1, 2, 1)[0], first[2])
    for other in (
        table.draw("b", 1, 0, 1),
        table.draw("a", 2, 0, 1),
        table.draw("a", 1, 1, 1),
        table.draw("a", 1, 0, 1, part=1),
        NoiseTable(1, (100, 100)).draw("a", 1, 0, 1),
    ):
        assert not torch.equal(other[0], first[0])


def test_items_of_any_size_have_numbers_of_their_own():
    large = NoiseTable(0, (2**19,))
    draws = large.draw("a", 3, 0, SLICES - 1)
    assert len(draws) == 15 and len({float(draw[0]) for draw in draws}) == 15


def test_items_beyond_the_end_of_the_table_continue_at_its_beginning(monkeypatch):
    monkeypatch.setattr(noise_table, "LENGTH", 64)
    small = NoiseTable(0, (2, 4))
    items = small.draw("a", 0, 0, 100)
    assert items.shape == (100, 2, 4)
    for item in (0, 40, 99):
        assert torch.equal(small.draw("a", 0, item, 1)[0], items[item])
