"""DDIM inversion, and its noise from a table: a function of (seed, stream, step, part, item)."""

import functools
import itertools

import pytest
import torch

from threestudio_gaussiandreamer.diffusion import inversion, sds
from threestudio_gaussiandreamer.diffusion.inversion import SLICES, NoiseTable, invert

ABAR = sds.sd_alphas_cumprod()


def still(step):
    return torch.zeros_like(step.z)


def test_items_end_at_their_own_timesteps_with_their_own_fresh_noise():
    asked = []

    def predict(step):
        asked.append((step.index, step.rows.tolist(), step.t.tolist()))
        return torch.zeros_like(step.z)

    x, t = torch.ones(3, 1, 1, 2, dtype=torch.float64), torch.tensor([30, 0, 250])
    z = invert(predict, x, t, ABAR, 100)
    assert asked == [(0, [0, 2], [0, 0]), (1, [2], [100]), (2, [2], [200])]
    # without predicted noise only the scale changes
    torch.testing.assert_close(z[:, 0, 0, 0], (ABAR[t] / ABAR[0]).sqrt())
    x, t = torch.zeros(3, 1, dtype=torch.float64), torch.tensor([250, 30, 250])

    def noise(index):
        return 10.0**index * torch.tensor([[1.0], [2.0], [3.0]], dtype=torch.float64)

    together = invert(still, x, t, ABAR, 100, eta=1.0, fresh=noise)
    for item in range(3):
        own = [item]
        drawn = functools.partial(lambda rows, index: noise(index)[rows], own)
        alone = invert(still, x[own], t[own], ABAR, 100, eta=1.0, fresh=drawn)
        torch.testing.assert_close(together[own], alone)
    torch.testing.assert_close(together[2], 3 * together[0])


def test_an_inversion_is_undone_by_ddim_and_fresh_noise_is_ddpms():
    """With the exact noise of a known image, sampling back from the end gives the start."""
    image = torch.tensor([0.3, -0.5], dtype=torch.float64)
    eps = torch.tensor([1.2, -0.7], dtype=torch.float64)
    start = ABAR[0].sqrt() * image + (1 - ABAR[0]).sqrt() * eps
    z = invert(lambda step: eps.expand_as(step.z), start[None], torch.tensor([640]), ABAR, 70)
    torch.testing.assert_close(z[0], ABAR[640].sqrt() * image + (1 - ABAR[640]).sqrt() * eps)
    x, t = torch.zeros(1, 20000, dtype=torch.float64), torch.tensor([400])
    drawn = torch.randn(1, 20000, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    z = invert(still, x, t, ABAR, 400, eta=0.5, fresh=lambda index: drawn)
    now, later = ABAR[0], ABAR[400]
    deviation = 0.5 * ((1 - now) / (1 - later) * (1 - later / now)).sqrt()
    torch.testing.assert_close(z, deviation * drawn)
    x, t = torch.tensor([[0.5], [2.0], [1.0]], dtype=torch.float64), torch.tensor([0, 150, 250])
    z = invert(lambda step: step.z, x, t, ABAR, 100)
    assert torch.equal(z[0], x[0])
    for item, timesteps in ((1, (0, 100, 150)), (2, (0, 100, 200, 250))):
        expected = x[item]
        for now, later in itertools.pairwise(timesteps):
            expected = sds.ddim_step(expected[None], expected[None], ABAR[[now]], ABAR[[later]])[0]
        torch.testing.assert_close(z[item], expected)


@pytest.fixture(scope="module")
def table():
    return NoiseTable(0, (100, 100))


def test_draws_are_standard_normal_and_depend_on_seed_stream_step_and_part_alone(table):
    draws = [table.draw("a", step, 0, 3, part) for step in range(2) for part in range(2)]
    noise = torch.cat(draws).flatten(1)
    assert noise.shape == (12, 10_000)
    # five deviations of a mean, a variance and a correlation
    assert noise.mean(1).abs().max() < 0.05 and (noise.var(1) - 1).abs().max() < 0.08
    correlation = torch.corrcoef(noise) - torch.eye(12)
    assert correlation.abs().max() < 0.05
    first = table.draw("a", 1, 0, 3)
    table.draw("b", 7, 1, 1)
    assert torch.equal(table.draw("a", 1, 2, 1)[0], first[2])
    assert first.untyped_storage().data_ptr() == table._values.untyped_storage().data_ptr()
    assert torch.equal(NoiseTable(0, (100, 100)).draw("a", 1, 2, 1)[0], first[2])
    keys = ("b", 1, 0, 1), ("a", 2, 0, 1), ("a", 1, 1, 1), ("a", 1, 0, 1, 1)  # the last of part 1
    others = [table.draw(*key) for key in keys] + [NoiseTable(1, (100, 100)).draw("a", 1, 0, 1)]
    assert not any(torch.equal(other[0], first[0]) for other in others)


def test_items_of_any_size_have_numbers_of_their_own(monkeypatch):
    large = NoiseTable(0, (2**19,))
    draws = large.draw("a", 3, 0, SLICES - 1)
    assert len(draws) == 15 and len({float(draw[0]) for draw in draws}) == 15
    monkeypatch.setattr(inversion, "LENGTH", 64)
    small = NoiseTable(0, (2, 4))
    items = small.draw("a", 0, 0, 100)
    assert items.shape == (100, 2, 4)
    for item in (0, 40, 99):
        assert torch.equal(small.draw("a", 0, item, 1)[0], items[item])
