"""Budgets as users write them, and in dB."""

import re

import pytest

from tests.helpers.pruning import ball
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
from threestudio_gaussiandreamer.gaussians.simplify import Budget
from threestudio_gaussiandreamer.prune.command import parse
from threestudio_gaussiandreamer.prune.options import (
    PruneOptions,
    budget_of,
    combined_psnr,
    parse_bytes,
    parse_number,
    psnr_for_loss,
)
from threestudio_gaussiandreamer.prune.pipeline import remaining_budget


@pytest.mark.parametrize(
    ("asked", "spent", "left"),
    [(37, 40, 40.02), (30, 60, 30.004), (40, 40, None), (41, 40, None), (39.99999999, 40, None)],
)
def test_the_remaining_budget(asked, spent, left):
    stored = StoredCloud(ball(7).arrays(), pruned_to=spent)
    found = remaining_budget(Budget(psnr=asked), stored)
    assert found.psnr == (left and pytest.approx(left, abs=5e-3))
    if left is None:
        assert found.count == 7
    else:
        assert combined_psnr(spent, left) == pytest.approx(asked, abs=2e-3)


def test_the_psnr_that_loses_a_tenth_of_a_decibel():
    # two independent errors: their squares add
    psnr = psnr_for_loss(0.1, 35.0)
    assert 10 ** (-3.5) + 10 ** (-psnr / 10) == pytest.approx(10 ** (-3.49))


def test_sizes_and_decibels_are_read_with_their_units():
    sizes = {"500kB": 500_000, " 2 MB ": 2_000_000, "1.5g": 1_500_000_000, 7: 7}
    assert [parse_bytes(text, "bytes") for text in sizes] == [*sizes.values()]
    assert {parse_number(text, "psnr", "dB") for text in ("40", " 40dB ", "40 db", 40.0)} == {40.0}


@pytest.mark.parametrize(
    ("given", "said"),
    [
        *(
            ({"count": n}, "--count: expected a whole number from 1 on, got")
            for n in ("0", "1.5", "x")
        ),
        *(({"bytes": text}, "--bytes: expected a size such as") for text in ("2 potatoes", "1e3")),
        ({"bytes": "9" * 30 + "G"}, "below 2^63 bytes"),
        ({"bytes": "9" * 400}, "expected a number"),
        ({"psnr": "nan"}, "--psnr: expected a number"),
        ({"psnr": "-3"}, "--psnr: expected a number above 0 (dB), got -3"),
        ({"within": "0", "quality": 35}, "--within: expected a number from 0.001 to 30 (dB), "),
        *(({"auto": text}, "--auto: expected a") for text in ("0", "6", "nan")),
    ],
)
def test_a_budget_that_is_none_is_named(given, said):
    with pytest.raises(UserError, match=re.escape(said)) as caught:
        budget_of(PruneOptions(**given), "--")
    assert len(str(caught.value)) < 200


def test_a_gain_is_a_budget():
    assert budget_of(PruneOptions(auto="0.25dB"), "--")[-2:] == (0.25, pytest.approx(1e-4))
    assert budget_of(PruneOptions(auto=1, quality=30.0), "--")[-2:] == (1.0, pytest.approx(1e-3))
    for words in ("--auto in.ply out.ply", "in.ply out.ply --auto"):
        assert parse(words.split()).auto == "0.5"
    assert parse("in.ply --auto 1dB o".split()).auto == "1dB"
