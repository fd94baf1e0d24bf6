"""Timesteps that fall during a run."""

import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.diffusion.sds import sd_alphas_cumprod
from threestudio_gaussiandreamer.diffusion.timesteps import scheduled_timestep, time_priorities

ABAR = sd_alphas_cumprod()


def timestep(name, step, steps=101, low=20, high=980):
    return scheduled_timestep(name, step, steps, low, high, ABAR)


def test_linear_and_square_root():
    assert [timestep("linear", step) for step in (0, 25, 100, 500)] == [980, 740, 20, 20]
    assert [timestep("sqrt", step) for step in (0, 25, 100, 500)] == [980, 500, 20, 20]


def test_dreamtime_spends_steps_in_proportion_to_the_weight():
    """The share of a run above a timestep is the weights' share above it (a sum of its own)."""
    weights = time_priorities(ABAR)
    for step in (10, 40, 70, 95):
        t = timestep("dreamtime", step)
        share = float(weights[t:981].sum() / weights[20:981].sum())
        resolution = float(weights[20:981].max() / weights[20:981].sum())
        assert abs(share - step / 100) <= resolution


def test_priorities_are_those_of_the_paper():
    """W_d = sqrt((1 - abar) / abar); W_p is 1 from 500 to 800, and exp(-1/2) one width outside."""
    prior = time_priorities(ABAR) / ((1 - ABAR) / ABAR).sqrt()
    half = torch.tensor(-0.5, dtype=torch.float64).exp()
    expected = torch.stack([torch.ones_like(half)] * 2 + [half, half**4])
    torch.testing.assert_close(prior[[500, 800, 400, 300]], expected)
    torch.testing.assert_close(prior[950], torch.tensor(-0.125, dtype=torch.float64).exp())


def test_a_single_step_and_a_fixed_timestep():
    assert timestep("linear", 0, steps=1) == 980
    assert all(timestep("dreamtime", step, low=300, high=300) == 300 for step in (0, 50, 100))


def test_an_unknown_schedule_is_named():
    with pytest.raises(UserError, match="timestep_schedule 'squareroot'"):
        timestep("squareroot", 0)
