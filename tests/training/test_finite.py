"""Parameters and optimiser state that aren't finite are found and named."""

import pytest
import torch

from threestudio_gaussiandreamer.training.finite import (
    NonFiniteParameters,
    optimizer_tensors,
    require_finite,
)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_one_number_that_is_not_finite_is_named(value):
    bad = torch.zeros(5, 3)
    bad[4, 1] = value
    with pytest.raises(NonFiniteParameters, match=r"step 7: 1 of the 15 numbers of means are NaN"):
        require_finite([("quats", torch.ones(5, 4)), ("means", bad)], step=7)


def test_infinities_of_both_signs_and_numbers_whose_sum_overflows_are_told_apart():
    with pytest.raises(NonFiniteParameters, match="2 of the 2"):
        require_finite([("means", torch.tensor([float("inf"), -float("inf")]))], step=0)
    require_finite([("means", torch.full((1000,), 3e38)), ("empty", torch.zeros(0))], step=0)
    require_finite([], step=0)


def test_the_state_of_an_optimiser_is_part_of_it():
    """A squared gradient that overflows leaves finite parameters that never move again."""
    parameter = torch.nn.Parameter(torch.zeros(2))
    optimizer = torch.optim.Adam([{"params": [parameter], "name": "means"}])
    parameter.grad = torch.tensor([1.0, 1e30])
    optimizer.step()
    assert parameter.isfinite().all()
    with pytest.raises(NonFiniteParameters, match="1 of the 2 numbers of means.exp_avg_sq"):
        require_finite(optimizer_tensors(optimizer), step=1)
