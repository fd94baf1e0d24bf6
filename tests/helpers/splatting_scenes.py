"""Clouds and cameras, and their renders, compared with the specification's in float64."""

import math
from collections.abc import Iterator
from typing import NamedTuple
from unittest import mock

import torch
from hypothesis import HealthCheck, settings
from torch import Tensor

from threestudio_gaussiandreamer import splatting
from threestudio_gaussiandreamer.splatting import Rasterized, validation
from threestudio_gaussiandreamer.splatting.scene import Scene

# float32 against float64 without the worst 0.5 % of the rows (thresholds that fall the other way).
SINGLE = 2e-5
NO_CUTOFFS = {"alpha_min": 0.0, "alpha_max": 1.0, "stop": 0.0}
NAMES = ("means", "quats", "scales", "opacities", "colors")
BACKGROUND = torch.tensor([0.2, 0.5, 0.9])
repeatable = settings(max_examples=25, suppress_health_check=list(HealthCheck))


def rasterize(*arguments, **options) -> Rasterized:
    """Draw also the scales and opacities that `splatting.rasterize` refuses."""
    with mock.patch.object(validation, "check_ranges"):
        return splatting.rasterize(*arguments, **options)


class Cloud(NamedTuple):
    """The first five arguments of `rasterize`."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor

    def to(self, dtype: torch.dtype) -> "Cloud":
        return Cloud(*(x.to(dtype) for x in self))

    def pick(self, index) -> "Cloud":
        return Cloud(*(x[index] for x in self))

    def leaves(self) -> "Cloud":
        return Cloud(*(x.detach().clone().requires_grad_() for x in self))


def scene_of(cloud: Cloud, viewmats: Tensor, Ks: Tensor, width: int, height: int) -> Scene:
    """Return the arguments of backends, with a black background."""
    background = cloud.means.new_zeros(len(viewmats), cloud.colors.shape[-1])
    gaussians = dict(zip(NAMES, cloud, strict=True))
    cameras = {"viewmats": viewmats, "Ks": Ks, "background": background}
    return Scene(**gaussians, **cameras, width=width, height=height)


def random_cloud(n: int, seed=0, channels=3, size=0.15, stretch=0.6) -> Cloud:
    """Draw a float64 cloud in a ball of radius 1, moderately anisotropic, below the cap."""
    g = torch.Generator().manual_seed(seed)
    means = torch.randn(n, 3, generator=g, dtype=torch.float64) * 0.4
    quats = torch.randn(n, 4, generator=g, dtype=torch.float64)
    scales = size * torch.exp(stretch * torch.randn(n, 3, generator=g, dtype=torch.float64))
    opacities = 0.05 + 0.9 * torch.rand(n, generator=g, dtype=torch.float64)
    colors = torch.rand(n, channels, generator=g, dtype=torch.float64)
    return Cloud(means, quats, scales, opacities, colors)


EXTREMES = {
    "means": [0.0, 0.3, -0.7, 3.0, -3.0, 1e4, 1e30, math.nan, math.inf],
    "quats": [0.0, 1.0, -1.0, 1e-20, 1e-40, 1e20, math.nan],
    "scales": [1e-8, 1e-4, 1e-2, 0.3, 1.0, 100.0, 1e4, 0.0, math.inf],
    "opacities": [0.0, 1 / 1024, 0.5, 0.9, 1.0, math.nan],
    "colors": [0.0, 1.0, -2.0, math.nan],
}


def extreme_cloud(seed: int, n: int, extremes: dict[str, list[float]] = EXTREMES) -> Cloud:
    """Half of the entries are from ``extremes``; the second half's means are the first's."""
    g = torch.Generator().manual_seed(seed)
    cloud = random_cloud(n, seed)
    for name, x in zip(NAMES, cloud, strict=True):
        values = torch.tensor(extremes[name], dtype=torch.float64)
        picked = values[torch.randint(len(values), x.shape, generator=g)]
        # A value that isn't finite removes the whole Gaussian; rarely enough that most stay.
        rare = picked.isfinite() | (torch.rand(x.shape, generator=g) < 0.1)
        x.copy_(torch.where((torch.rand(x.shape, generator=g) < 0.5) & rare, picked, x))
    cloud.means[n // 2 :] = cloud.means[: n - n // 2].clone()
    return cloud


def stacks_on_one_pixel(n: int = 10_000) -> Iterator[Cloud]:
    """Return clouds of ``n`` Gaussians that project to one pixel, of mixed and of low opacity."""
    g = torch.Generator().manual_seed(5)
    offsets, depths = torch.randn(n, 2, generator=g), torch.rand(n, 1, generator=g)
    means = torch.cat([0.05 * offsets, 2 + depths], 1).double()
    for opacities in (0.01 + 0.89 * torch.rand(n, generator=g), torch.full((n,), 0.002)):
        yield random_cloud(n, seed=5)._replace(means=means, opacities=opacities.double())


def cameras(views: int, width: int, height: int, distance=3.0, fov=50.0, dtype=torch.float64):
    """Return viewmats and Ks on a circle that look at the origin; ``fov`` vertical, degrees."""
    focal = 0.5 * height / math.tan(math.radians(fov) / 2)
    K = [[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]]
    Ks = torch.tensor(K, dtype=dtype).expand(views, 3, 3)
    viewmats = torch.eye(4, dtype=dtype).repeat(views, 1, 1)
    for view in range(views):
        angle, tilt = 0.3 + 2 * math.pi * view / views, 0.4
        along = math.cos(angle) * math.cos(tilt), math.sin(angle) * math.cos(tilt), math.sin(tilt)
        back = torch.tensor(along, dtype=dtype)
        right = torch.linalg.cross(-back, torch.tensor([0.0, 0, 1], dtype=dtype))
        right /= right.norm()
        viewmats[view, :3, :3] = torch.stack([right, torch.linalg.cross(-back, right), -back])
        viewmats[view, 2, 3] = distance
    return viewmats, Ks.contiguous()


def front_camera(width: int, height: int, focal: float) -> tuple[Tensor, Tensor]:
    """Return a camera at the origin that looks along +z."""
    Ks = torch.tensor([[[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1.0]]]).double()
    return torch.eye(4, dtype=torch.float64)[None], Ks


def one_gaussian(mean=(0.0, 0.0, 2.0), scale=0.1, opacity=0.5, color=(1.0, 0.5, 0.25)) -> Cloud:
    """Return a float64 Gaussian without rotation, isotropic unless ``scale`` has three entries."""
    scales = scale if isinstance(scale, tuple) else (scale,) * 3
    rows = (mean, (1.0, 0, 0, 0), scales, opacity, color)
    return Cloud(*(torch.tensor([row], dtype=torch.float64) for row in rows))


def cotangents(out: Rasterized) -> tuple[Tensor, ...]:
    """Return fixed random gradients of image, alpha and depth, equal for every precision."""
    g, images = torch.Generator().manual_seed(1), (out.image, out.alpha, out.depth)
    drawn = (torch.randn(x.shape, generator=g, dtype=torch.float64) for x in images)
    return tuple(gradient.to(x.dtype) for gradient, x in zip(drawn, images, strict=True))


class Run(NamedTuple):
    out: Rasterized
    grads: dict[str, Tensor]
    """Of the five attributes, means2d, and of background and viewmats where given."""


def run(
    cloud: Cloud, viewmats, Ks, width, height, background=None, camera_gradient=False, **options
):
    """Run forward and backward in the cloud's precision with fixed cotangents."""
    dtype, leaves = cloud.means.dtype, cloud.leaves()
    viewmats = viewmats.detach().to(dtype).requires_grad_(camera_gradient)
    background = None if background is None else background.detach().to(dtype).requires_grad_()
    view = viewmats, Ks.to(dtype), width, height
    out = rasterize(*leaves, *view, background=background, **options)
    torch.autograd.backward([out.image, out.alpha, out.depth], cotangents(out))
    inputs = zip((*NAMES, "means2d"), (*leaves, out.means2d), strict=True)
    grads = {name: leaf.grad for name, leaf in inputs}
    if background is not None:
        grads["background"] = background.grad
    if camera_gradient:
        grads["viewmats"] = viewmats.grad
    return Run(out, grads)


def error(a: Tensor, b: Tensor) -> float:
    """Return the relative L2 distance of ``a`` from the reference ``b``."""
    return ((a.double() - b.double()).norm() / b.double().norm().clamp(min=1e-30)).item()


def trimmed_error(a: Tensor, b: Tensor, kept: float = 0.995) -> float:
    """Return the same without the worst rows, of Gaussians at a threshold."""
    a, b = a.double().reshape(len(a), -1), b.double().reshape(len(b), -1)
    distance = (a - b).norm(dim=1)
    rows = distance <= distance.quantile(kept)
    return (distance[rows].norm() / b[rows].norm().clamp(min=1e-30)).item()


def psnr(a: Tensor, b: Tensor) -> float:
    return -10 * math.log10(max(((a.double() - b.double()) ** 2).mean().item(), 1e-30))


def equal(a: Run, b: Run) -> bool:
    """Return whether all bits are equal."""
    outputs = all(torch.equal(x, y) for x, y in zip(a.out, b.out, strict=True))
    return outputs and all(torch.equal(grad, b.grads[name]) for name, grad in a.grads.items())


def draw(backend: str, cloud: Cloud, camera, width, height, background=None, **options) -> Run:
    """Run forward and backward in float32."""
    view = *(x.to(torch.float32) for x in camera), width, height, background
    return run(cloud.to(torch.float32), *view, backend=backend, **options)


_specified: dict[tuple, Run] = {}


def specified(cloud: Cloud, *view, **options) -> Run:
    """Return what the specification draws in float64; computed once for all kernels."""
    options = {"backend": "reference"} | options
    values = [*cloud, *view, *options.values()]
    key = *options, *(x.numpy().tobytes() if isinstance(x, Tensor) else x for x in values)
    if key not in _specified:
        _specified[key] = run(cloud, *view, **options)
    return _specified[key]


def compare(backend: str, cloud: Cloud, camera, *view, tolerance: float = SINGLE, **options) -> Run:
    """Assert images and gradients within float32 rounding of the specification in float64."""
    truth = specified(cloud, *camera, *view, camera_gradient=True, **options)
    ours = draw(backend, cloud, camera, *view, camera_gradient=True, **options)
    for name in ("image", "alpha", "depth", "means2d", "contribution"):
        picture, true = getattr(ours.out, name), getattr(truth.out, name)
        assert error(picture, true) < SINGLE or (picture - true).abs().max() < 1e-7, name
    radii = ours.out.radii.double(), truth.out.radii
    assert options.get("alpha_min") == 0 or torch.allclose(*radii, rtol=1e-5)
    for name, grad in truth.grads.items():
        pair = ours.grads[name], grad
        by_gaussian = [x.transpose(0, 1) if name == "means2d" else x for x in pair]
        near = trimmed_error(*by_gaussian) < tolerance or (pair[0] - grad).abs().max() < 1e-7
        assert near, name
    if options.get("absgrad"):
        assert error(ours.out.means2d.absgrad, truth.out.means2d.absgrad) < SINGLE
    return ours
