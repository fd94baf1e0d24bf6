"""Small scenes, and their images by the textbook formulas, for references and emulated faults."""

import torch
from torch import Tensor

from tests.helpers.splatting_scenes import Cloud, Run, one_gaussian


def joined(*clouds: Cloud) -> Cloud:
    return Cloud(*(torch.cat(attributes) for attributes in zip(*clouds, strict=True)))


def stack(opacities: list[float], **options) -> Cloud:
    """Return Gaussians of these opacities with equal shape and position."""
    one = one_gaussian(**options)
    return Cloud(*(x.repeat(len(opacities), *[1] * (x.dim() - 1)) for x in one))._replace(
        opacities=torch.tensor(opacities).double()
    )


def finite(result: Run) -> bool:
    """Return all outputs except the radii, which are infinite if no threshold bounds a Gaussian."""
    return all(
        x.isfinite().all()
        for x in (*result.out._replace(radii=result.out.alpha), *result.grads.values())
    )


def pixels(width: int, height: int) -> Tensor:
    """Return the pixel centres, (height, width, 2)."""
    return torch.stack(
        torch.meshgrid(torch.arange(width) + 0.5, torch.arange(height) + 0.5, indexing="xy"), -1
    ).double()


def clamped_slope(x: Tensor, z: Tensor, limit: float) -> Tensor:
    return torch.clamp(x / z, -limit, limit)


def clamped_alpha(
    mean: Tensor, scales: Tensor, width: int, focal: float, opacity: float, slope_of=clamped_slope
) -> Tensor:
    """Return the alpha (width, width) of an unrotated Gaussian, with J at the clamped slope; the
    camera looks along z.
    """
    x, y, z = mean
    slopes = [slope_of(a, z, 1.3 * 0.5 * width / focal) for a in (x, y)]
    zero = torch.zeros_like(z)
    J = torch.stack(
        [
            torch.stack([focal / z, zero, -focal / z * slopes[0]]),
            torch.stack([zero, focal / z, -focal / z * slopes[1]]),
        ]
    )
    covariance = J @ torch.diag(scales**2) @ J.T + 0.3 * torch.eye(2, dtype=torch.float64)
    offsets = pixels(width, width) - focal * torch.stack([x, y]) / z - 0.5 * width
    return opacity * torch.exp(-0.5 * (offsets @ covariance.inverse() * offsets).sum(-1))


def plain_image(
    cloud: Cloud, width: int, height: int, focal: float, visible: Tensor, order: Tensor
) -> Tensor:
    """Composite isotropic Gaussians in ``order``, (height, width, 3); only ``visible`` is
    respected.
    """
    image, T = torch.zeros(height, width, 3).double(), torch.ones(height, width).double()
    for i in order.tolist():
        if visible[i]:
            x, y, z = cloud.means[i]
            variance = (focal * cloud.scales[i, 0] / z) ** 2 + 0.3
            offsets = pixels(width, height) - torch.stack(
                [focal * x / z + 0.5 * width, focal * y / z + 0.5 * height]
            )
            alpha = cloud.opacities[i] * torch.exp(-0.5 * (offsets**2).sum(-1) / variance)
            image, T = image + (T * alpha)[..., None] * cloud.colors[i], T * (1 - alpha)
    return image
