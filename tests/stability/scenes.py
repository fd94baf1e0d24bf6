"""Small scenes, and their images by the textbook formulas, for references and emulated faults."""

import numpy as np
import torch
from torch import Tensor

from tests.helpers.pixel_guidance import TowardsGrey
from tests.helpers.splatting_scenes import Cloud, Run, front_camera, one_gaussian, rasterize
from threestudio_gaussiandreamer.cameras import Orbit
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.host import register
from threestudio_gaussiandreamer.splatting import Rasterized
from threestudio_gaussiandreamer.training.geometry import GaussianCloud


@register("stability-corrupted-guidance")
class CorruptedScore(TowardsGrey):
    """Replace the score of some items, at the steps in ``corrupted``, by a value."""

    corrupted: dict[int, dict[int, float]] = {}

    def predict(self, z, t, condition):
        eps, _ = super().predict(z, t, condition)
        for item, value in self.corrupted.get(self.step, {}).items():
            eps[item] = value
        return eps, None


def score_gradient(guidance: CorruptedScore, rgb: Tensor, step: int = 0) -> tuple[Tensor, dict]:
    """Return the gradient at a step with respect to the images, and the guidance's output."""
    guidance.update_step(0, step)
    image = rgb.clone().requires_grad_()
    out = guidance(image)
    return torch.autograd.grad(out["loss_sds"], image)[0], out


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def joined(*clouds: Cloud) -> Cloud:
    return Cloud(*(torch.cat(attributes) for attributes in zip(*clouds, strict=True)))


def stack(opacities: list[float], **options) -> Cloud:
    """Return Gaussians of these opacities with equal shape and position."""
    equal = one_gaussian(**options).pick([0] * len(opacities))
    return equal._replace(opacities=torch.tensor(opacities).double())


def drawn(backend: str, cloud: Cloud, width: int, height: int, focal: float, **options):
    """Draw in float32 from the origin along +z; gradients flow."""
    camera = [x.float() for x in front_camera(width, height, focal)]
    cloud = cloud.to(torch.float32)
    return rasterize(*cloud, *camera, width, height, backend=backend, **options)


def ball(n: int = 300, seed: int = 0) -> PointCloud:
    """Return coloured points on a sphere of radius 0.7."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points.astype(np.float32), rng.random((n, 3), np.float32))


def started(n: int = 300, seed: int = 0, **options) -> GaussianCloud:
    """Return the first cloud of a :func:`ball`, without grown points."""
    geometry = GaussianCloud({"grow": {"enabled": False}, **options})
    geometry.start_from(ball(n, seed))
    return geometry


def orbit(*views) -> Orbit:
    """Return cameras of (elevation, azimuth, distance, vertical field of view), in degrees."""
    elevation, azimuth, distance, fovy = torch.tensor(views).T
    return Orbit(elevation, azimuth, distance, torch.deg2rad(fovy))


def finite(result: Run) -> bool:
    """Whether all outputs are, except radii, infinite where no threshold bounds a Gaussian."""
    outputs: Rasterized = result.out._replace(radii=result.out.alpha)
    return all(x.isfinite().all() for x in (*outputs, *result.grads.values()))


def pixels(width: int, height: int) -> Tensor:
    """Return the pixel centres, (height, width, 2)."""
    axes = torch.arange(width) + 0.5, torch.arange(height) + 0.5
    return torch.stack(torch.meshgrid(*axes, indexing="xy"), -1).double()


def clamped_slope(x: Tensor, z: Tensor, limit: float) -> Tensor:
    return torch.clamp(x / z, -limit, limit)


def clamped_alpha(mean, scales, width: int, focal: float, opacity: float, slope_of=clamped_slope):
    """Return the alpha (width, width) of an unrotated Gaussian, with J at the clamped slope."""
    x, y, z = mean
    slopes = [slope_of(a, z, 1.3 * 0.5 * width / focal) for a in (x, y)]
    zero = torch.zeros_like(z)
    rows = [focal / z, zero, -focal / z * slopes[0]], [zero, focal / z, -focal / z * slopes[1]]
    J = torch.stack([torch.stack(row) for row in rows])
    covariance = J @ torch.diag(scales**2) @ J.T + 0.3 * torch.eye(2, dtype=torch.float64)
    offsets = pixels(width, width) - focal * torch.stack([x, y]) / z - 0.5 * width
    return opacity * torch.exp(-0.5 * (offsets @ covariance.inverse() * offsets).sum(-1))


def plain_image(cloud: Cloud, width: int, height: int, focal: float, visible, order) -> Tensor:
    """Composite isotropic Gaussians in ``order``, (height, width, 3), if ``visible``."""
    image, T = torch.zeros(height, width, 3).double(), torch.ones(height, width).double()
    middle = torch.tensor([0.5 * width, 0.5 * height])
    for i in order[visible[order]].tolist():
        x, y, z = cloud.means[i]
        variance = (focal * cloud.scales[i, 0] / z) ** 2 + 0.3
        offsets = pixels(width, height) - (focal * torch.stack([x / z, y / z]) + middle)
        alpha = cloud.opacities[i] * torch.exp(-0.5 * (offsets**2).sum(-1) / variance)
        image, T = image + (T * alpha)[..., None] * cloud.colors[i], T * (1 - alpha)
    return image
