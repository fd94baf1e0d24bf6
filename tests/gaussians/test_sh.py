"""Spherical harmonics against scipy, an independent evaluation."""

import math

import numpy as np
import pytest
import torch
from scipy import special

from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.gaussians import sh


def directions(n=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=g, dtype=torch.float64)


def by_scipy(dirs, degree):
    """Real harmonics from associated Legendre functions (Condon-Shortley phase)."""
    x, y, z = (dirs / dirs.norm(dim=-1, keepdim=True)).numpy().T
    phi, basis = np.arctan2(y, x), []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            factorials = math.factorial(band - abs(m)) / math.factorial(band + abs(m))
            norm = math.sqrt((2 * band + 1) / (4 * math.pi) * factorials)
            wave = math.sqrt(2) * (np.sin if m < 0 else np.cos)(abs(m) * phi) if m else 1
            basis.append(norm * special.lpmv(abs(m), band, z) * wave)
    return np.stack(basis, -1)


@pytest.mark.parametrize("degree", range(4))
def test_basis_and_colors_equal_scipys_of_one_or_several_views(degree):
    ours = torch.stack(sh.sh_basis(directions(), degree), -1)
    np.testing.assert_allclose(ours, by_scipy(directions(), degree), atol=1e-13)
    coefficients = np.random.default_rng(1).normal(size=(50, (degree + 1) ** 2, 3))
    views = torch.stack([directions(seed=s) * (1 + s) for s in range(3)])
    colors = sh.sh_to_colors(torch.from_numpy(coefficients), views)
    sums = [np.einsum("nk,nkc->nc", by_scipy(v, degree), coefficients) for v in views]
    expected = np.maximum(0, 0.5 + np.stack(sums))
    np.testing.assert_allclose(colors, expected, atol=1e-12)
    assert torch.equal(sh.sh_to_colors(torch.from_numpy(coefficients), views[0]), colors[0])
    assert (colors == 0).any() == (expected == 0).any()
    few = torch.from_numpy(0.05 * coefficients[:5]).requires_grad_()
    assert torch.autograd.gradcheck(sh.sh_to_colors, (few, directions(5).requires_grad_()))


def test_rgb_round_trip_and_gradients_of_bounded_colors():
    rgb = torch.rand(20, 3, generator=torch.Generator().manual_seed(3))
    assert torch.allclose(sh.sh0_to_rgb(sh.rgb_to_sh0(rgb)), rgb, atol=1e-6)
    constant = sh.sh_to_colors(sh.rgb_to_sh0(rgb)[:, None], directions(20).float())
    assert torch.allclose(constant, rgb, atol=1e-6)
    assert sh.C0 == pytest.approx(0.28209479177387814, rel=1e-15)
    colors = torch.tensor([-0.5, 0.0, 0.5, 1.0, 2.2]).repeat(2).requires_grad_()
    bounded = sh.bounded_colors(colors)
    assert bounded.tolist() == [0, 0, 0.5, 1, 1] * 2
    # descent decreases the first five colours and increases the others
    bounded.backward(torch.tensor([0.3] * 5 + [-0.3] * 5))
    expected = torch.tensor([0, 0, 0.3, 0.3, 0.3, -0.3, -0.3, -0.3, 0, 0])
    assert torch.equal(colors.grad, expected)


def test_zero_directions_autocast_and_numbers_of_coefficients_that_are_no_square():
    dirs = torch.zeros(2, 3, requires_grad=True)
    colors = sh.sh_to_colors(torch.ones(2, 16, 3), dirs)
    colors.sum().backward()
    assert colors.isfinite().all() and (dirs.grad == 0).all()
    coefficients = torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(4))
    dirs = directions(20).float()
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = sh.sh_to_colors(coefficients, dirs)
    assert cast.dtype == torch.float32 and torch.equal(cast, sh.sh_to_colors(coefficients, dirs))
    refused("1, 4, 9 or 16", sh.sh_to_colors, torch.zeros(3, 5, 3), torch.ones(3, 3))
