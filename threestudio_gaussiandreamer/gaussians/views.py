"""Fixed views around Gaussians: cameras, their images, and the PSNR between two sets of Gaussians.

Recovery, pruning and the choice of initial points compare Gaussians with an earlier version of
themselves in such views, not with training images."""

import math
from typing import Any, NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import intrinsics, orbit_c2w, to_opencv
from ..core.errors import UserError
from ..core.streams import generator
from ..metrics import MAX_PSNR, psnr
from ..splatting import Rasterized, rasterize
from .gaussians import Gaussians
from .sh import sh_to_colors

LEAST_ERROR, MOST_ERROR = 10 ** (-MAX_PSNR / 10), 10 ** (MAX_PSNR / 10)
"""Range of mean squared errors; smaller ones are below the rounding errors of float32."""
FOVY = math.radians(50.0)
EPS2D = 0.3
"""Screen-space dilation, square pixels; the value that viewers use."""
NEAR = 0.01
"""Near plane, in units of the cloud's radius, since the unit of a cloud is unknown."""
MAX_RADIUS = 1e15
"""Largest radius of a cloud, in its units: squares of distances stay within float32's range."""
VIEWS_PER_CALL, GAUSSIANS_PER_CALL = 4, 2_000_000
"""Most views that are rendered at once, and most Gaussians of all of them, about 500 bytes each."""
SINES, DISTANCES = (-0.5, 0.9), (1.0, 1.4)
"""Of the views by default: the range of the sine of the elevation, and relative distances."""


class Views(NamedTuple):
    """V square views from all directions, and how they are rendered."""

    viewmats: Float[Tensor, "V 4 4"]
    Ks: Float[Tensor, "V 3 3"]
    positions: Float[Tensor, "V 3"]
    size: int
    """Pixels each way."""
    near: float = NEAR
    """Near plane, in the cloud's units."""
    backgrounds: Optional[Float[Tensor, "V 3"]] = None
    """Background colour of each view; None is grey."""
    eps2d: float = EPS2D
    """Screen-space dilation, square pixels."""
    antialias: bool = False

    def rows(self, index: Any) -> "Views":
        """Select views; ``index`` is anything that indexes a tensor's first dimension."""
        per_view = ("viewmats", "Ks", "positions", "backgrounds")
        given = {name: getattr(self, name) for name in per_view}
        return self._replace(**{k: v if v is None else v[index] for k, v in given.items()})


Ball = tuple[Float[Tensor, "3"], float]
"""Centre and radius."""


def bounds(cloud: Gaussians) -> Ball:
    """Return the opacity-weighted median of the positions, and the radius of the ball around it
    that holds 99 % of the opacity, where the distance of each Gaussian is that of its mean plus one
    standard deviation along its longest axis.
    """
    weights = cloud.logit_opacities.sigmoid()
    centre = torch.stack([_quantile(axis, weights, 0.5) for axis in cloud.means.unbind(1)])
    distances = (cloud.means - centre).norm(dim=1) + cloud.log_scales.exp().amax(1)
    return centre, float(_quantile(distances, weights, 0.99).clamp_min(1e-12))


def _quantile(values: Float[Tensor, " N"], weights: Float[Tensor, " N"], share: float) -> Tensor:
    order = values.argsort()
    mass = weights[order].cumsum(0)
    return values[order[int(torch.searchsorted(mass, share * mass[-1]).clamp_max(len(values) - 1))]]


def views_around(
    cloud: Gaussians,
    count: int,
    size: int,
    *,
    turn: float = 0.0,
    to_z_up: Optional[Float[Tensor, "3 3"]] = None,
    ball: Optional[Ball] = None,
    sines: tuple[float, float] = SINES,
    distances: tuple[float, ...] = DISTANCES,
) -> Views:
    """Place views around Gaussians on a golden-angle spiral, at alternating distances.

    Each view has its own random background, so that Gaussians of the background's colour still
    have a removal error and opacities are observed.

    Args:
        size: width and height of the images, pixels.
        turn: azimuth of the first view, degrees.
        to_z_up: rotation from the cloud's axes to axes with z up.
        ball: ``bounds(cloud)`` if it is already known.
        sines: of the elevations of the first and the last view.
        distances: relative to that at which the ball of :func:`bounds` fills the view.

    Raises:
        UserError: the radius of the cloud exceeds ``MAX_RADIUS``.
    """
    centre, radius = ball or bounds(cloud)
    require_renderable(cloud, radius)
    index = torch.arange(count)
    elevation = torch.rad2deg(torch.asin(torch.linspace(*sines, count)))
    distance = radius / math.sin(FOVY / 2) * torch.tensor(distances)[index % len(distances)]
    azimuth = (turn + index * 137.50776) % 360.0
    c2w = orbit_c2w(elevation, azimuth, distance).to(centre)
    if to_z_up is not None:
        c2w[:, :3] = to_z_up.T.to(c2w) @ c2w[:, :3]
    c2w[:, :3, 3] += centre
    fovy = torch.full((count,), FOVY, device=centre.device)
    viewmats, _ = to_opencv(c2w, fovy, size, size)
    rng = generator(0, "backgrounds", count, round(turn))
    backgrounds = torch.rand(count, 3, generator=rng).to(centre)
    Ks = intrinsics(fovy, size, size)
    return Views(viewmats, Ks, c2w[:, :3, 3], size, NEAR * radius, backgrounds)


def require_renderable(cloud: Gaussians, radius: float) -> None:
    """Raise UserError if the radius of a cloud exceeds ``MAX_RADIUS``."""
    if not radius <= MAX_RADIUS:
        raise UserError(
            f"the Gaussians reach further than {MAX_RADIUS:g} units from their centre, which "
            f"float32 can't render: the largest scale is "
            f"{float(cloud.log_scales.amax().exp()):g}; rescale them or remove the largest"
        )


def rasterize_views(
    cloud: Gaussians,
    views: Views,
    rows: Tensor,
    background: Optional[Float[Tensor, "... C"]] = None,
    *,
    opacities: Optional[Float[Tensor, " N"]] = None,
    channels: Optional[Float[Tensor, "B N K"]] = None,
) -> Rasterized:
    """Rasterize some of the views.

    Args:
        rows: (B,) indices of the views.
        background: by default that of the views, or grey.
        opacities: used instead of the cloud's own, for gradients with respect to them.
        channels: composited after the three colours.
    """
    if background is None:
        grey = torch.full((3,), 0.5, device=cloud.means.device)
        background = grey if views.backgrounds is None else views.backgrounds[rows]
    # a single direction, of shape (1, 3), where the colours don't depend on it, saves most of the
    # time and memory outside the rasteriser
    directions = cloud.means.new_tensor([[0.0, 0.0, 1.0]])
    if cloud.sh.shape[1] > 1:
        away = cloud.means.detach() - views.positions[rows, None]
        directions = torch.nn.functional.normalize(away, dim=-1)
    colors = sh_to_colors(cloud.sh, directions)
    if channels is not None:
        colors = torch.cat([colors.expand(len(rows), -1, -1), channels], dim=-1)
    if opacities is None:
        opacities = cloud.logit_opacities.sigmoid()
    return rasterize(
        *(cloud.means, cloud.quats, cloud.log_scales.exp(), opacities, colors),
        *(views.viewmats[rows], views.Ks[rows], views.size, views.size),
        background=background,
        near=views.near,
        far=math.inf,
        eps2d=views.eps2d,
        antialias=views.antialias,
    )


def render_all(cloud: Gaussians, views: Views) -> Float[Tensor, "V H W 3"]:
    """Render the images of all views, without gradients."""
    return render_with_contribution(cloud, views)[0]


@torch.no_grad()
def render_with_contribution(
    cloud: Gaussians, views: Views
) -> tuple[Float[Tensor, "V H W 3"], Float[Tensor, " N"]]:
    """Render the images of all views; return each Gaussian's largest contribution to any too."""
    images, contribution = [], torch.zeros_like(cloud.logit_opacities)
    for rows in row_batches(views, len(cloud.means)):
        out = rasterize_views(cloud, views, rows)
        images.append(out.image)
        contribution = torch.maximum(contribution, out.contribution.amax(0))
    return torch.cat(images), contribution


def row_batches(views: Views, gaussians: int) -> tuple[Tensor, ...]:
    """Return the indices of the views in batches that are rendered at once."""
    size = min(VIEWS_PER_CALL, max(1, GAUSSIANS_PER_CALL // max(1, gaussians)))
    return torch.arange(len(views.viewmats)).split(size)


def psnr_to_original(cloud: Gaussians, views: Views, images: Float[Tensor, "V H W 3"]) -> float:
    """Return the PSNR of a cloud's views to given images of them, over all pixels, dB."""
    return float(psnr(render_all(cloud, views).flatten(0, 1), images.flatten(0, 1)))


def psnr_lower_bound(cloud: Gaussians, views: Views, images: Float[Tensor, "V H W 3"]) -> float:
    """Estimate a lower bound of the PSNR in views other than these, dB: the PSNR at the mean
    squared error of the views plus two standard errors.
    """
    errors = (render_all(cloud, views) - images).square().mean((1, 2, 3))
    errors = errors.nan_to_num(nan=MOST_ERROR).clamp_max(MOST_ERROR)
    upper = float(errors.mean() + 2 * errors.std() / math.sqrt(len(errors)))
    return -10 * math.log10(max(upper, LEAST_ERROR))
