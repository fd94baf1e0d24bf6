"""Budgets in dB."""

import pytest

from threestudio_gaussiandreamer.prune.options import (
    combined_psnr,
    psnr_for_loss,
    remaining_psnr_budget,
)


@pytest.mark.parametrize(
    ("asked", "spent", "left"),
    [
        (37.0, 40.0, 40.02),
        (30.0, 60.0, 30.004),
        (40.0, 40.0, None),
        (41.0, 40.0, None),
        (39.99999999, 40.0, None),
    ],
)
def test_the_remaining_budget(asked, spent, left):
    assert remaining_psnr_budget(asked, spent) == (left and pytest.approx(left, abs=5e-3))
    assert left is None or combined_psnr(spent, left) == pytest.approx(asked, abs=2e-3)


def test_the_psnr_that_loses_a_tenth_of_a_decibel():
    # two independent errors: their squares add
    psnr = psnr_for_loss(0.1, 35.0)
    assert 10 ** (-3.5) + 10 ** (-psnr / 10) == pytest.approx(10 ** (-3.49))
