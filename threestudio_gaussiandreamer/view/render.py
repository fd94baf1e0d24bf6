"""Render a cloud with this package's rasteriser: the settings and cameras of the page, pictures
with a transparent background, and a colour that suits them as one."""

import math
from pathlib import Path
from typing import Any, NamedTuple, Optional

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..cameras import orbit_c2w, to_opencv
from ..core.errors import UserError
from ..formats.gaussian_files import StoredCloud
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.gaussians import Gaussians
from ..gaussians.sh import bounded_colors, sh_to_unclamped_colors
from ..gaussians.views import EPS2D, FOVY, NEAR, Ball, bounds, require_renderable
from ..splatting import PRESETS, rasterize

ELEVATION, AZIMUTH = 15.0, 30.0
"""The first view, degrees: the front, from slightly above and to the right."""
MARGIN = 1.1
"""Distance of the first view, relative to the one at which the whole cloud just fits."""
FAINT, GAP = 0.05, 0.1
"""What may lie outside the first view: Gaussians of a smaller opacity, and those that are further
from the others than this share of the cloud's radius."""

Color = tuple[float, float, float]
"""RGB in [0, 1]."""
WHITE: Color = (1.0, 1.0, 1.0)
BACKDROPS: tuple[Color, ...] = (WHITE, (0.5, 0.5, 0.5), (0.125, 0.125, 0.125))
LEAST_CONTRAST, OUTLINE_SHARE = 0.15, 0.25
"""An object vanishes on a colour from which this share of its outline differs less in RGB."""


class RenderSettings(NamedTuple):
    """Renderer options that change how Gaussians look; set them as in the training."""

    eps2d: float = EPS2D
    """Screen-space dilation, square pixels."""
    antialias: bool = False
    alpha_min: float = PRESETS["balanced"]
    bound_colors: bool = True
    near: float = NEAR
    """World units."""
    far: float = 1e10

    @classmethod
    def of(cls, renderer: Any, bound_colors: bool) -> "RenderSettings":
        """Collect the options of our renderer, whose ``eps2d`` is in pixels before downsampling."""
        return cls(
            eps2d=renderer.eps2d / renderer.downsample**2,
            antialias=renderer.antialias,
            alpha_min=PRESETS[renderer.preset],
            bound_colors=bound_colors,
        )


class Pose(NamedTuple):
    """A camera that looks at a point, in the world's axes."""

    target: tuple[float, float, float]
    distance: float
    elevation: float = ELEVATION
    """Degrees above the horizon."""
    azimuth: float = AZIMUTH
    """Degrees from +x towards +y."""
    fovy: float = math.degrees(FOVY)
    """Degrees."""


def require_gaussians(count: int, name: str) -> None:
    """Raise UserError if a cloud has no Gaussians to show."""
    if not count:
        raise UserError(f"{name} has no Gaussians that can be drawn: there is nothing to show")


def first_pose(cloud: StoredCloud) -> Pose:
    """Return the pose that shows the whole cloud from the front; UserError if it is too large."""
    gaussians = cloud.gaussians.tensors()
    ball = bounds(gaussians)
    require_renderable(gaussians, ball[1])
    centre, radius = _whole(gaussians, ball)
    to_world = torch.from_numpy(rotation_between(cloud.up, WORLD_UP)).float()
    target = (to_world @ centre).tolist()
    return Pose(tuple(target), MARGIN * radius / math.sin(FOVY / 2))


def _whole(cloud: Gaussians, ball: Ball) -> Ball:
    """Extend the ball of :func:`bounds` outwards to all Gaussians, which end at two standard
    deviations, before the first gap: a thin hat belongs to the cloud, and a floater doesn't.
    """
    centre, radius = ball
    deviation = cloud.log_scales.exp().amax(1)
    distances = (cloud.means - centre).norm(dim=1)
    plain = (cloud.logit_opacities.sigmoid() >= FAINT) & (deviation <= radius)
    counted = plain | (distances + deviation <= radius)
    means, distances, reach = cloud.means[counted], distances[counted], 2 * deviation[counted]
    inner, order = (distances - reach).sort()
    outer = (distances + reach)[order].cummax(0).values.clamp_min(radius)
    after_gap = inner[1:] > outer[:-1] + GAP * radius
    kept = order[: 1 + int((after_gap.cumsum(0) == 0).sum())]
    means, reach = means[kept], reach[kept]
    lowest, highest = (means - reach[:, None]).amin(0), (means + reach[:, None]).amax(0)
    middle = (lowest + highest) / 2
    return middle, float(((means - middle).norm(dim=1) + reach).max())


@torch.no_grad()
def render(
    cloud: StoredCloud, settings: RenderSettings, poses: list[Pose], size: int
) -> Float[Tensor, "V size size 4"]:
    """Render square views, ``size`` pixels each way: premultiplied colour, and alpha."""
    gaussians, views = cloud.gaussians.tensors(), []
    options = settings._asdict()
    bound_colors = options.pop("bound_colors")
    shape = (gaussians.means, gaussians.quats, gaussians.log_scales.exp())
    for pose in poses:
        c2w, fovy = camera_of(pose, cloud.up), torch.tensor([math.radians(pose.fovy)])
        colors = sh_to_unclamped_colors(gaussians.sh, gaussians.means - c2w[:, :3, 3])
        colors = bounded_colors(colors) if bound_colors else colors.clamp_min(0)
        look = (gaussians.logit_opacities.sigmoid(), colors)
        camera = (*to_opencv(c2w, fovy, size, size), size, size)
        out = rasterize(*shape, *look, *camera, **options)
        views.append(torch.cat([out.image, out.alpha], -1))
    return torch.cat(views)


def camera_of(pose: Pose, up: str) -> Float[Tensor, "1 4 4"]:
    """Return the OpenGL camera of a pose in the axes of a cloud whose up axis is ``up``."""
    target = torch.tensor([pose.target])
    angles = [torch.tensor([x]) for x in (pose.elevation, pose.azimuth, pose.distance)]
    c2w = orbit_c2w(*angles, center=torch.zeros(1, 3))
    c2w[:, :3, 3] += target
    c2w[:, :3] = torch.from_numpy(rotation_between(WORLD_UP, up)).float() @ c2w[:, :3]
    return c2w


# ---- pictures ------------------------------------------------------------------------------------


def picture(cloud: StoredCloud, settings: RenderSettings, pose: Pose, size: int) -> Any:
    """Render one view as a Pillow image RGBA, ``size`` pixels each way."""
    from PIL import Image

    view = render(cloud, settings, [pose], size)[0]
    alpha = view[..., 3:]
    # files hold colours that aren't multiplied by alpha
    straight = torch.cat([view[..., :3] / alpha.clamp_min(1e-6), alpha], -1)
    return Image.fromarray((255 * straight.clamp(0, 1)).round().byte().numpy(), "RGBA")


def backdrop(image: Any, wanted: Color) -> Color:
    """Return ``wanted``, or the one of ``BACKDROPS`` with the most contrast if the object of a
    Pillow image RGBA would vanish on it.
    """
    pixels = np.asarray(image) / 255
    opaque = pixels[..., 3] > 0.5
    moved = [np.roll(opaque, step, axis) for axis in (0, 1) for step in (-1, 1)]
    outline = pixels[opaque & ~np.logical_and.reduce(moved)][:, :3]
    if not len(outline):
        return wanted

    def contrast(color: Color) -> float:
        return float(np.quantile(np.abs(outline - color).max(1), OUTLINE_SHARE))

    return wanted if contrast(wanted) >= LEAST_CONTRAST else max(BACKDROPS, key=contrast)


def backdrop_of_file(path: Path) -> Optional[Color]:
    """Return the backdrop on a white page of a picture; None if it is opaque or can't be read."""
    from PIL import Image

    try:
        image = Image.open(path)
        return backdrop(image, WHITE) if image.mode == "RGBA" else None
    except Exception:  # Pillow raises many kinds for damaged files
        return None


def hex_color(color: Color) -> str:
    """Return a colour as #rrggbb."""
    return "#" + bytes(round(255 * x) for x in color).hex()
