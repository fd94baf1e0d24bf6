"""Bootstrap intervals over prompts, and paired differences."""

import math

import numpy as np
import pytest

from threestudio_gaussiandreamer.evaluation.intervals import bootstrap, paired, per_prompt


def test_the_interval_of_many_values_is_that_of_the_normal_distribution():
    values = np.random.default_rng(0).normal(3.0, 2.0, 400)
    found, error = bootstrap(values), values.std() / math.sqrt(len(values))
    assert found.mean == pytest.approx(values.mean())
    assert found.low == pytest.approx(values.mean() - 1.96 * error, abs=0.15 * error)
    assert found.high == pytest.approx(values.mean() + 1.96 * error, abs=0.15 * error)


def test_undefined_values_are_left_out():
    assert bootstrap(np.array([1.0, np.nan, 1.0])) == (1.0, 1.0, 1.0, 2)
    empty = bootstrap(np.array([np.nan]))
    assert math.isnan(empty.mean) and empty.count == 0


def test_seeds_of_a_prompt_count_once():
    means = per_prompt(["a", "a", "b", "c"], np.array([0.0, 1.0, 3.0, np.nan]))
    assert means["a"] == 0.5 and means["b"] == 3.0 and math.isnan(means["c"])


def test_differences_are_of_common_prompts():
    first, second = {"a": 2.0, "b": 5.0, "c": 9.0}, {"b": 4.0, "a": 1.0, "d": 0.0}
    assert paired(first, second) == (1.0, 1.0, 1.0, 2)
