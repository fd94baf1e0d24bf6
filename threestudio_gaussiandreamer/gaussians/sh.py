"""View-dependent colour as real spherical harmonics of degree 0 to 3, evaluated before blending.

Coefficients are in the order and with the signs that 3D Gaussian splatting files use: (l, m) = (0,
0), (1, -1), (1, 0), (1, 1), (2, -2), ..., with the Condon-Shortley phase, so odd m carry a minus
sign. The colour of a direction is ``max(0, 0.5 + sum_k Y_k(direction) sh_k)``."""

from math import pi, sqrt
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError

C0 = sqrt(1 / (4 * pi))
COEFFICIENTS = (1, 4, 9, 16)  # by degree
MAX_DEGREE = len(COEFFICIENTS) - 1
Colors = Float[Tensor, "*batch C"] | Float[np.ndarray, "*batch C"]


def rgb_to_sh0(rgb: Colors | float) -> Colors | float:
    """Return the coefficients of degree 0 for colours in [0, 1], or for one channel."""
    return (rgb - 0.5) / C0


def sh0_to_rgb(sh0: Colors) -> Colors:
    """Invert :func:`rgb_to_sh0`; not clamped."""
    return 0.5 + C0 * sh0


def sh0_colors(sh0: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3"]:
    """Return the colours of coefficients of degree 0, clipped to [0, 1]."""
    return sh0_to_rgb(sh0).clip(0.0, 1.0)


def sh_to_colors(
    sh: Float[Tensor, "N K C"], dirs: Float[Tensor, "*views #N 3"]
) -> Float[Tensor, "*views N C"]:
    """Compute the colours seen along ``dirs``, clamped at 0.

    Args:
        dirs: from the camera to the Gaussians, of any length.

    Raises:
        UserError: K isn't 1, 4, 9 or 16.
    """
    return sh_to_unclamped_colors(sh, dirs).clamp_min(0)


def sh_to_unclamped_colors(
    sh: Float[Tensor, "N K C"], dirs: Float[Tensor, "*views #N 3"]
) -> Float[Tensor, "*views N C"]:
    """Compute the colours of :func:`sh_to_colors` without the clamp; same arguments and errors."""
    if sh.shape[-2] not in COEFFICIENTS:
        raise UserError(
            "sh must have the shape (N, K, C) with K = 1, 4, 9 or 16 for degree 0 to 3; got "
            f"{tuple(sh.shape)}."
        )
    basis = sh_basis(dirs, COEFFICIENTS.index(sh.shape[-2]))
    # Not a matrix product, which autocast would compute in a lower precision.
    return 0.5 + sum(b[..., None] * sh[:, k] for k, b in enumerate(basis))


class _Bounded(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, colors: Tensor) -> Tensor:
        ctx.save_for_backward(colors)
        return colors.clamp(0, 1)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        (colors,) = ctx.saved_tensors
        leaves = (colors >= 1) & (gradient < 0) | (colors <= 0) & (gradient > 0)
        return torch.where(leaves, 0.0, gradient)


def bounded_colors(colors: Float[Tensor, "*batch C"]) -> Float[Tensor, "*batch C"]:
    """Clamp colours to [0, 1], the range that viewers show.

    At a bound and beyond it, a gradient is passed on if a descent step leads towards the range, so
    that colours outside can return, and is 0 otherwise.
    """
    return _Bounded.apply(colors)


def sh_basis(dirs: Float[Tensor, "*batch 3"], degree: int) -> list[Float[Tensor, "*batch"]]:
    """Evaluate the (degree + 1)^2 real spherical harmonics at the normalised directions, as
    polynomials in x, y, z.

    Normalisation sqrt((2l + 1) / 4 pi (l - |m|)! / (l + |m|)!), times sqrt(2) for m != 0 (Sloan
    2008, Stupid Spherical Harmonics Tricks, appendix A2)."""
    length = torch.linalg.vector_norm(dirs, dim=-1, keepdim=True)
    usable = length > 1e-12  # otherwise +z with zero gradient, since 0 / 0 is NaN
    up = dirs.new_tensor([0.0, 0.0, 1.0])
    x, y, z = torch.where(usable, dirs / torch.where(usable, length, 1), up).unbind(-1)
    basis = [torch.full_like(x, C0)]
    if degree >= 1:
        c1 = sqrt(3 / (4 * pi))
        basis += [-c1 * y, c1 * z, -c1 * x]
    if degree >= 2:
        c2, c20 = sqrt(15 / (4 * pi)), sqrt(5 / (16 * pi))
        basis += [c2 * x * y, -c2 * y * z, c20 * (3 * z * z - 1)]
        basis += [-c2 * x * z, 0.5 * c2 * (x * x - y * y)]
    if degree >= 3:
        c33, c32 = sqrt(35 / (32 * pi)), sqrt(105 / (4 * pi))
        c31, c30 = sqrt(21 / (32 * pi)), sqrt(7 / (16 * pi))
        basis += [-c33 * y * (3 * x * x - y * y), c32 * x * y * z, -c31 * y * (5 * z * z - 1)]
        basis += [c30 * z * (5 * z * z - 3), -c31 * x * (5 * z * z - 1)]
        basis += [0.5 * c32 * z * (x * x - y * y), -c33 * x * (x * x - 3 * y * y)]
    return basis
