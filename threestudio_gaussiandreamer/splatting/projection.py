"""From 3-D Gaussians to splats on the screen: the first stage of the image model, in torch, for any
float type.

The formulas are EWA splatting (Zwicker et al. 2001) with the conventions of 3D Gaussian Splatting
(Kerbl et al. 2023): a Gaussian with mean ``t`` in camera coordinates becomes a 2-D Gaussian with
mean ``pinhole(t)`` and covariance ``J W S W' J' + eps2d I``, with the pinhole's Jacobian ``J``."""

from typing import NamedTuple

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..core.tensors import rotation_rows
from .scene import RasterizeOptions, Scene

SMALLEST_QUATERNION = 1e-12
FRUSTUM_MARGIN = 0.3
ZERO = torch.zeros(())


class Splats(NamedTuple):
    """Projected Gaussians, the input of the blend; invisible ones are zero with zero gradients.

    ``conics`` are (a, k, c) of the completed square ``d' cov^-1 d = a (d.x - k d.y)^2 + c d.y^2``,
    that is ``a = cov.yy / det``, ``k = cov.xy / cov.yy``, ``c = 1 / cov.yy``. Unlike the form with
    the entries of ``cov^-1``, this has no cancellation for thin Gaussians other than that in
    ``d.x - k d.y``."""

    means2d: Float[Tensor, "B N 2"]  # pixels, centres at +0.5
    conics: Float[Tensor, "B N 3"]
    opacities: Float[Tensor, "B N"]  # after the antialiasing compensation
    depths: Float[Tensor, "B N"]  # t.z, world units
    extents: Float[Tensor, "B N 2"]  # pixels, half the box around alpha >= alpha_min; no gradient
    visible: Bool[Tensor, "B N"]

    @property
    def radii(self) -> Float[Tensor, "B N"]:
        """The larger half extent, pixels; 0 for invisible ones, inf if ``alpha_min`` is 0."""
        return self.extents.amax(-1)


def project(scene: Scene, options: RasterizeOptions) -> Splats:
    """Project all Gaussians into all views; differentiable in the Gaussians and the viewmats.

    A first pass without gradients finds the visible Gaussians. The second pass replaces the inputs
    of all others by constants *before* the formulas, so that no NaN or overflow reaches a gradient
    (0 * NaN is NaN). A Gaussian with a colour that isn't finite is invisible."""
    means, quats, scales, opacities, viewmats, colors, _, Ks = scene.tensors
    width, height = scene.size
    finite = torch.stack([_finite(x) for x in (means, quats, scales, opacities)]).all(0)
    means, quats, scales, opacities = (_keep(finite, x) for x in (means, quats, scales, opacities))
    # only the entries that are used
    cameras_finite = _finite(viewmats[:, :3]) & _finite(Ks[:, [0, 1, 0, 1], [0, 1, 2, 2]])
    viewmats = _keep(cameras_finite, viewmats, torch.eye(4))
    Ks = _keep(cameras_finite, Ks, torch.eye(3))

    t, axes = _to_camera(means, quats, scales, viewmats)
    with torch.no_grad():
        candidates = _to_screen(t, axes, opacities, Ks, width, height, options)
        drawable = finite & colors.isfinite().all(-1) & cameras_finite[:, None]
        visible = drawable & _visible(*candidates, width, height, options)
    t, axes = _keep(visible, t, torch.tensor([0.0, 0.0, 1.0])), _keep(visible, axes, torch.eye(3))
    # the intrinsics of a view without visible Gaussians may overflow even with constants
    Ks = _keep(visible.any(1), Ks, torch.eye(3))
    splats = _to_screen(t, axes, opacities, Ks, width, height, options)
    return Splats(*(_keep(visible, x) for x in splats), visible)


def quats_to_rotations(quats: Float[Tensor, "*batch 4"]) -> Float[Tensor, "*batch 3 3"]:
    """Convert quaternions wxyz of any length to rotation matrices.

    Quaternions whose entries are all below 1e-12 give the identity, with zero gradient. Dividing by
    the largest entry first keeps squares within float32's range; the rotation doesn't depend on
    that divisor, so it is detached."""
    largest = quats.detach().abs().amax(-1, keepdim=True)
    usable = largest >= SMALLEST_QUATERNION
    identity = quats.new_tensor([1.0, 0, 0, 0])
    q = torch.where(usable, quats / torch.where(usable, largest, 1), identity)
    w, x, y, z = (q / torch.linalg.vector_norm(q, dim=-1, keepdim=True)).unbind(-1)
    return torch.stack([torch.stack(row, -1) for row in rotation_rows(w, x, y, z)], -2)


def _to_camera(means, quats, scales, viewmats) -> tuple[Tensor, Tensor]:
    """Return the means (B, N, 3) and scaled axes, columns (B, N, 3, 3), in camera coordinates."""
    rotations, translations = viewmats[:, None, :3, :3], viewmats[:, None, :3, 3]
    axes = quats_to_rotations(quats) * scales[:, None, :]
    # Explicit sums, because the rounding of a library's matrix product may depend on the number of
    # threads.
    t = translations + sum(rotations[..., j] * means[:, j, None] for j in range(3))
    return t, sum(rotations[..., j, None] * axes[:, None, j] for j in range(3))


def _to_screen(t, axes, opacities, Ks, width, height, options) -> tuple[Tensor, ...]:
    """Return the fields of `Splats` up to ``extents``, not finite where there is no projection."""
    u0, u1 = _project_axes(t, axes, Ks, width, height)
    conics, variances, compensation = _invert_covariance(u0, u1, options.eps2d)
    depths = t[..., 2]
    centres = [Ks[:, i, i, None] * (t[..., i] / depths) + Ks[:, i, 2, None] for i in (0, 1)]
    opacities = opacities * compensation if options.antialias else opacities.expand_as(depths)
    extents = _extents(variances.detach(), opacities.detach(), options.alpha_min)
    return torch.stack(centres, -1), conics, opacities, depths, extents


def _project_axes(t, axes, Ks, width, height) -> tuple[Tensor, Tensor]:
    """Compute the two rows of ``J @ axes``: the change of pixel x and y along each scaled axis.

    ``J = [[fx/z, 0, -fx x/z^2], [0, fy/z, -fy y/z^2]]`` with x/z and y/z clamped to the image plus
    a margin of 15 % of its size on each side, beyond which the linearisation is unbounded. The
    gradient is that of the clamped formula."""
    z, rows = t[..., 2], []
    for i, size in ((0, width), (1, height)):
        focal, centre = Ks[:, i, i, None], Ks[:, i, 2, None]
        margin = FRUSTUM_MARGIN * 0.5 * size / focal
        low, high = -centre / focal - margin, (size - centre) / focal + margin
        slope = torch.clamp(t[..., i] / z, low, high)
        rows.append((focal / z)[..., None] * (axes[..., i, :] - slope[..., None] * axes[..., 2, :]))
    return rows[0], rows[1]


def _invert_covariance(u0, u1, eps2d) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the conics, the variances (cov.xx, cov.yy) and ``sqrt(det(U U') / det(cov))`` of
    ``cov = U U' + eps2d I``.

    By Lagrange's identity ``det(U U') = |u0 x u1|^2``, so with ``v = u1 / sqrt(cov.yy)``
    ``det / cov.yy = |u0 x v|^2 + eps2d (1 + |u0|^2 / cov.yy)``. All terms are positive, so there is
    no cancellation, and they stay within float32's range where ``det`` itself overflows."""
    before_xx, before_yy = (u0 * u0).sum(-1), (u1 * u1).sum(-1)
    xx, xy, yy = before_xx + eps2d, (u0 * u1).sum(-1), before_yy + eps2d
    area = torch.linalg.vector_norm(torch.linalg.cross(u0, u1 / yy.sqrt()[..., None]), dim=-1)
    dilation = eps2d * (1 + before_xx / yy)
    conics = torch.stack([1 / (area * area + dilation), xy / yy, 1 / yy], -1)
    return conics, torch.stack([xx, yy], -1), _compensation(area, dilation)


def _compensation(area, dilation) -> Tensor:
    """Compute ``area / sqrt(area^2 + dilation)``, so that no gradient has cancellation."""
    small = area * area < dilation
    ratio = area * torch.where(small, dilation, 1).rsqrt()
    inverse_square = dilation / torch.where(small, 1, area) ** 2
    return torch.where(small, ratio * (1 + ratio * ratio).rsqrt(), (1 + inverse_square).rsqrt())


def _extents(variances, opacities, alpha_min) -> Tensor:
    """Compute half the box around ``opacity exp(-q/2) >= alpha_min``."""
    if alpha_min == 0:
        return torch.full_like(variances, torch.inf)
    return (2 * torch.log(opacities / alpha_min)[..., None] * variances).sqrt()


def _visible(means2d, conics, opacities, depths, extents, width, height, options) -> Tensor:
    """Return which are in range, finite, not too faint, and overlap the image by their box."""
    in_range = (depths > options.near) & (depths < options.far)
    finite = conics.isfinite().all(-1) & means2d.isfinite().all(-1)
    positive = (conics[..., 0] > 0) & (conics[..., 2] > 0)
    low, high = means2d + extents >= 0, means2d - extents <= means2d.new_tensor([width, height])
    opaque = opacities >= options.alpha_min
    return in_range & finite & positive & opaque & (low & high).all(-1)


def _finite(x) -> Tensor:
    """Return whether all values of each item of the first dimension are finite; allows 0 items."""
    finite = x.isfinite()
    while finite.dim() > 1:
        finite = finite.all(-1)
    return finite


def _keep(mask, x, otherwise=ZERO) -> Tensor:
    """Select ``x`` where the mask over its leading dimensions is true, else ``otherwise``."""
    return torch.where(mask.reshape(mask.shape + (1,) * (x.dim() - mask.dim())), x, otherwise.to(x))
