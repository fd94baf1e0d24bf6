"""A number with a given gradient."""

import pytest
import torch

from threestudio_gaussiandreamer.core.given_gradient import given_gradient


@pytest.mark.parametrize("factor", [1.0, 0.5, -3.0, 0.0])
def test_the_gradient_is_the_given_one_times_what_follows(factor):
    x = torch.randn(2, 3, requires_grad=True)
    gradient, value = torch.randn(2, 3), torch.tensor(7.0)
    number = given_gradient(x, gradient, value)
    (factor * number).backward()
    assert number == 7 and torch.equal(x.grad, factor * gradient)


def test_the_given_gradient_is_neither_changed_nor_shared():
    x = torch.zeros(4, requires_grad=True)
    gradient = torch.ones(4)
    number = given_gradient(x, gradient, torch.tensor(0.0))
    number.backward(retain_graph=True)
    number.backward()
    assert torch.equal(x.grad, torch.full((4,), 2.0)) and torch.equal(gradient, torch.ones(4))
    x.grad.zero_()
    assert torch.equal(gradient, torch.ones(4))
