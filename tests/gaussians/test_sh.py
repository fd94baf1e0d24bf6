"""Spherical harmonics against scipy, an independent evaluation."""

import math

import numpy as np
import pytest
import torch
from scipy import special

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians import sh


def directions(n=50, seed=0):
    g = torch.Generator().manual_seed(seed)
    return torch.randn(n, 3, generator=g, dtype=torch.float64)


def by_scipy(dirs, degree):
    """Compute real harmonics from associated Legendre functions (with the Condon-Shortley phase)
    and cos, sin of m phi.
    """
    x, y, z = (dirs / dirs.norm(dim=-1, keepdim=True)).numpy().T
    phi, basis = np.arctan2(y, x), []
    for band in range(degree + 1):
        for m in range(-band, band + 1):
            norm = math.sqrt(
                (2 * band + 1)
                / (4 * math.pi)
                * math.factorial(band - abs(m))
                / math.factorial(band + abs(m))
            )
            legendre = norm * special.lpmv(abs(m), band, z)
            basis.append(
                legendre
                if m == 0
                else math.sqrt(2) * legendre * (np.sin if m < 0 else np.cos)(abs(m) * phi)
            )
    return np.stack(basis, -1)


@pytest.mark.parametrize("degree", range(4))
def test_basis_equals_scipy(degree):
    ours = torch.stack(sh.sh_basis(directions(), degree), -1)
    np.testing.assert_allclose(ours, by_scipy(directions(), degree), atol=1e-13)


def test_basis_is_orthonormal():
    """Gauss-Legendre in z times a regular grid in phi integrates products of degree 6 exactly."""
    z, weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * 2 * np.pi / 16
    z, phi = np.meshgrid(z, phi, indexing="ij")
    dirs = torch.from_numpy(
        np.stack([np.sqrt(1 - z**2) * np.cos(phi), np.sqrt(1 - z**2) * np.sin(phi), z], -1)
    )
    basis = torch.stack(sh.sh_basis(dirs, 3), -1).numpy()
    gram = np.einsum("i,ijk,ijl->kl", weights * 2 * np.pi / 16, basis, basis)
    np.testing.assert_allclose(gram, np.eye(16), atol=1e-13)


@pytest.mark.parametrize("degree", range(4))
def test_colors_of_one_or_several_views(degree):
    coefficients = torch.randn(
        50, (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64
    )
    views = torch.stack([directions(seed=s) * (1 + s) for s in range(3)])
    colors = sh.sh_to_colors(coefficients, views)
    expected = np.stack(
        [
            np.maximum(0, 0.5 + np.einsum("nk,nkc->nc", by_scipy(v, degree), coefficients))
            for v in views
        ]
    )
    np.testing.assert_allclose(colors, expected, atol=1e-12)
    assert torch.equal(sh.sh_to_colors(coefficients, views[0]), colors[0])
    assert (colors == 0).any() == (expected == 0).any()


@pytest.mark.parametrize("degree", range(4))
def test_gradients_equal_finite_differences(degree):
    coefficients = 0.05 * torch.randn(
        5, (degree + 1) ** 2, 3, generator=torch.Generator().manual_seed(2), dtype=torch.float64
    )
    inputs = coefficients.requires_grad_(), directions(5).requires_grad_()
    assert torch.autograd.gradcheck(sh.sh_to_colors, inputs)


def test_rgb_round_trip_and_constant_color():
    rgb = torch.rand(20, 3, generator=torch.Generator().manual_seed(3))
    assert torch.allclose(sh.sh0_to_rgb(sh.rgb_to_sh0(rgb)), rgb, atol=1e-6)
    assert torch.allclose(
        sh.sh_to_colors(sh.rgb_to_sh0(rgb)[:, None], directions(20).float()), rgb, atol=1e-6
    )
    assert sh.C0 == pytest.approx(0.28209479177387814, rel=1e-15)


def test_bounded_colors_pass_gradients_that_lead_into_the_range():
    colors = torch.tensor([-0.5, 0.0, 0.5, 1.0, 2.2]).repeat(2).requires_grad_()
    bounded = sh.bounded_colors(colors)
    assert bounded.tolist() == [0, 0, 0.5, 1, 1] * 2
    # descent decreases the first five colours and increases the others
    bounded.backward(torch.tensor([0.3] * 5 + [-0.3] * 5))
    expected = torch.tensor([0, 0, 0.3, 0.3, 0.3, -0.3, -0.3, -0.3, 0, 0])
    assert torch.equal(colors.grad, expected)


def test_a_zero_direction_gives_finite_colours():
    dirs = torch.zeros(2, 3, requires_grad=True)
    colors = sh.sh_to_colors(torch.ones(2, 16, 3), dirs)
    colors.sum().backward()
    assert colors.isfinite().all() and (dirs.grad == 0).all()


def test_autocast_changes_nothing():
    coefficients, dirs = (
        torch.randn(20, 16, 3, generator=torch.Generator().manual_seed(4)),
        directions(20).float(),
    )
    with torch.autocast("cpu", dtype=torch.bfloat16):
        cast = sh.sh_to_colors(coefficients, dirs)
    assert cast.dtype == torch.float32 and torch.equal(cast, sh.sh_to_colors(coefficients, dirs))


def test_a_number_of_coefficients_that_is_no_square_is_refused():
    with pytest.raises(UserError, match="1, 4, 9 or 16"):
        sh.sh_to_colors(torch.zeros(3, 5, 3), torch.ones(3, 3))
