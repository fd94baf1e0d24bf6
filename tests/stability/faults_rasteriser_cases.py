"""Helpers of the tests of rasteriser faults."""

import torch


def single(camera):
    return [x.to(torch.float32) for x in camera]


def central_difference(f, x: float, step: float = 1e-5) -> float:
    return (
        f(torch.tensor(x + step, dtype=torch.float64))
        - f(torch.tensor(x - step, dtype=torch.float64))
    ).item() / (2 * step)


def slope_error(f, x: float, truth) -> float:
    """Return the relative error of autograd's derivative of ``f`` at ``x`` against the finite
    difference of ``truth``.
    """
    leaf = torch.tensor(x, dtype=torch.float64).requires_grad_()
    (slope,) = torch.autograd.grad(f(leaf), leaf)
    expected = central_difference(truth, x)
    return abs(slope.item() - expected) / abs(expected)
