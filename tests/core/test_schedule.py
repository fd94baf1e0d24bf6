"""Schedules: values that change with the step or the epoch."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from omegaconf import OmegaConf

from threestudio_gaussiandreamer.core import schedule
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.core.schedule import C, parse_schedule, validate_schedule


@pytest.mark.parametrize(
    ("value", "step", "expected"),
    [
        (0.5, 7, 0.5),
        (3, 7, 3),
        ([1.0, 3.0, 10], 0, 1.0),
        ([1.0, 3.0, 10], 5, 2.0),
        ([1.0, 3.0, 10], 99, 3.0),
        ((4, 1.0, 3.0, 8), 4, 1.0),
        ((4, 1.0, 3.0, 8), 6, 2.0),
        # the paper's switch of the largest timestep
        ([500, 0.98, 0.55, 501], 500, 0.98),
        ([500, 0.98, 0.55, 501], 501, 0.55),
        # the released code's clipping: three knots at 0, 1000, 2000
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 500, 1.75),
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 1500, 2.5),
        ([0, 1.5, 2.0, 1000, 3.0, 2000], 5000, 3.0),
        (OmegaConf.create([1.0, 3.0, 10]), 5, 2.0),
    ],
)
def test_schedule_by_step(value, step, expected):
    assert C(value, epoch=0, global_step=step) == pytest.approx(expected, abs=1e-12)


def test_a_fractional_end_counts_epochs():
    assert C([0, 0.0, 1.0, 10.0], epoch=5, global_step=9999) == 0.5
    assert C([0, 0.0, 1.0, 10], epoch=5, global_step=2) == 0.2


WRONG = {
    "expected a number": ("0.5", None, True, math.inf, {"a": 1}),
    "finite numbers": ([0, "a", 2.0, 10], [0, True, 2.0, 10], [0, math.nan, 2.0, 10]),
    "elements": ([], [1.0], [1.0, 2.0], [0, 1.0, 2.0, 10, 3.0], [0, 1.0, 2.0, 10, 3.0, 20, 4.0]),
    "don't increase": ([5, 1.0, 2.0, 5], [0, 1.0, 2.0, 20, 3.0, 10], [1.0, 2.0, 0]),
    "mixes": ([0, 1.0, 2.0, 10, 3.0, 20.0],),
    "no whole number": ([0, 8e-4, 2e-5], [0, 0.98, 0.55, 0.5]),  # the first lacks its last number
}


@pytest.mark.parametrize(("said", "values"), WRONG.items())
def test_anything_else_is_no_schedule(said, values):
    for value in values:
        with pytest.raises(UserError, match=f"^grad_clip is .*{said}"):
            validate_schedule(value, "grad_clip")
        with pytest.raises(UserError):
            C(value, 0, 0)


@given(st.lists(st.floats(-10, 10), min_size=3, max_size=6), st.integers(-5, 80))
def test_a_piecewise_schedule_is_numpys_interpolation(values, step):
    steps = [10 * i for i in range(len(values))]
    knots = [steps[0], values[0]] + [
        x for pair in zip(values[1:], steps[1:], strict=True) for x in pair
    ]
    # exact up to the rounding of one multiplication
    assert C(knots, 0, step) == pytest.approx(np.interp(step, steps, values), abs=1e-12)
    assert max(parse_schedule(knots).values) == max(values)


def test_a_schedule_in_epochs_is_warned_of_once(monkeypatch):
    warned = []
    monkeypatch.setattr(schedule, "warn", lambda text: warned.append(text.partition(":")[0]))
    for _ in range(2):
        validate_schedule([0, 8e-4, 2e-5, 500.0], "system.geometry.lr_in_epochs")
        validate_schedule([0, 8e-4, 2e-5, 500.0], "geometry.lr_in_epochs")
    validate_schedule([0, 8e-4, 2e-5, 500], "lr_in_steps")
    assert warned == ["system.geometry.lr_in_epochs"]
