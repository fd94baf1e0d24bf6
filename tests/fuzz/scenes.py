"""Extreme scenes for the rasteriser, drawn from a seed, and what every backend must satisfy."""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple, Optional

import torch
from torch import Tensor

from tests.helpers.splatting_scenes import NAMES, Cloud, Run, cotangents, rasterize
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.splatting.projection import quats_to_rotations

MAX = 3.4028235e38
DENORMAL = 1e-42
PIXELS_TIMES_GAUSSIANS = 2_000_000
"""Largest scene, since the specification evaluates every Gaussian at every pixel."""
ROUNDING = 2e-5
"""Smallest distance of depths whose order float32 resolves, for means up to 50."""
FLIPS = 4 / 1024
"""Of pixels: a few Gaussians' faintest contribution (1/1024) may fall beyond the threshold."""
GRADIENTS = 1e-2
"""Of gradients, relative, without the worst hundredth of the Gaussians, those at a threshold."""

SIZES = (0.0, DENORMAL, 1e-30, 1e-8, 1e-4, 0.05, 1.0, 1e2, 1e4, 1e10, 1e30, MAX)
PLACES = (0.0, -0.0, DENORMAL, 0.01, -0.01, 0.3, 1.0, -1.0, 10.0, -1e4, 1e8, 1e20, -1e30, MAX)
LENGTHS = (0.0, DENORMAL, 1e-30, 1e-13, 1e-12, 1e-3, 1.0, 5.0, 1e10, 1e20, 1e30, MAX)
OPACITIES = (0.0, -0.0, DENORMAL, 1 / 1024, 1 / 255, 0.5, 1 - 2**-10, 1.0, 1.5, -1.0, 100.0)
HARMONICS = (0.0, -0.0, DENORMAL, -1.0, 1.0, 1e4, -1e10)
BRIGHT = (1e30, -1e30, MAX, -MAX)
"""SH coefficients whose pixels are finite, but not their gradients (by focal length / depth)."""
NOT_FINITE = (math.nan, math.inf, -math.inf)
NEAR = (0.01, 0.01, 1e-6, 0.5)
FOVS_DEG = (1e-3, 0.1, 1.0, 30.0, 60.0, 120.0, 179.0, 179.999)


class Scene(NamedTuple):
    """Arguments of `rasterize`, with colours as spherical harmonics."""

    cloud: Cloud
    """float32; ``colors`` are harmonics (N, K, 3)."""
    viewmats: Tensor
    Ks: Tensor
    size: tuple[int, int]
    """Width and height."""
    background: Optional[Tensor]
    options: dict[str, Any]


def extreme_scene(seed: int, most: int = 4000) -> Scene:
    """Draw a scene of up to ``most`` Gaussians; a tenth of the scenes contains NaN and infinity."""
    g = torch.Generator().manual_seed(seed)
    count = _log_uniform(g, most) - 1 if _chance(g, 0.4) else most
    views = int(torch.randint(1, 5, (), generator=g))
    size = _size(g, max(count * views, 1))
    cloud = _cloud(g, count, non_finite=bool(_chance(g, 0.1)))
    viewmats, Ks = _cameras(g, views, *size)
    background = torch.randn(3, generator=g) if _chance(g, 0.5) else None
    return Scene(cloud, viewmats, Ks, size, background, _options(g, size))


def well_posed(scene: Scene) -> Scene:
    """Select the Gaussians on which float32 backends must agree: finite, of moderate size and
    position, clear of the near plane; none under a field of view of less than a degree or more than
    150, where neither rounding nor the clamped Jacobian is moderate."""
    cloud, near = scene.cloud, scene.options["near"]
    lengths = torch.linalg.vector_norm(cloud.quats, dim=1)
    keep = (cloud.means.abs() <= 50).all(1) & (lengths >= 1e-3) & (lengths <= 1e3)
    keep &= ((cloud.scales >= 1e-3) & (cloud.scales <= 10)).all(1)
    keep &= (cloud.opacities >= 0) & (cloud.opacities <= 1)
    keep &= (cloud.colors.abs() <= 10).flatten(1).all(1)
    rotated = scene.viewmats[:, 2, :3].double() @ cloud.means.double().T
    depths = rotated + scene.viewmats[:, 2, 3:].double()
    keep &= ((depths - near).abs() > 0.05).all(0)
    for view in depths:
        keep[keep.nonzero()[:, 0][_of_mixed_depth(cloud.means[keep], view[keep])]] = False
    focal, width = scene.Ks[:, 0, 0], scene.size[0]
    moderate = bool(((focal > 0.13 * width) & (focal < 57 * width)).all())
    return scene._replace(cloud=cloud.pick(keep if moderate else slice(0, 0)))


def _of_mixed_depth(means: Tensor, depths: Tensor) -> Tensor:
    """Mark Gaussians whose depth order depends on rounding; equal positions are ordered."""
    order = depths.argsort(stable=True)
    near = depths[order].diff() < ROUNDING
    groups = torch.cat([near.new_zeros(len(order[:1]), dtype=torch.long), (~near).cumsum(0)])
    mixed = torch.zeros_like(groups, dtype=torch.bool)
    mixed[groups[1:][near & (means[order].diff(dim=0) != 0).any(1)]] = True
    marked = torch.zeros_like(mixed)
    marked[order] = mixed[groups]
    return marked


def _chance(g: torch.Generator, share: float) -> bool:
    return bool(torch.rand((), generator=g) < share)


def _log_uniform(g: torch.Generator, most: int) -> int:
    return int(math.exp(torch.rand((), generator=g).item() * math.log(most + 1)))


def _size(g: torch.Generator, work: int) -> tuple[int, int]:
    """Draw a size: 1 x 1, odd, elongated or square, limited by the specification's cost."""
    area = min(max(PIXELS_TIMES_GAUSSIANS // work, 1), 48 * 48)
    width = min(_log_uniform(g, area), 200)
    width = max(round(math.sqrt(area)) if _chance(g, 0.5) else width, 1)
    return width, max(min(area // width, 200), 1)


def _picked(g: torch.Generator, values: tuple[float, ...], shape: tuple[int, ...]) -> Tensor:
    return torch.tensor(values)[torch.randint(len(values), shape, generator=g)]


def _cloud(g: torch.Generator, count: int, non_finite: bool) -> Cloud:
    """Draw ordinary Gaussians with extreme rows and entries; some rows are copies of others."""
    degree = int(torch.randint(0, 4, (), generator=g))
    cloud = Cloud(
        means=0.5 * torch.randn(count, 3, generator=g),
        quats=torch.randn(count, 4, generator=g),
        scales=torch.exp(torch.randn(count, 3, generator=g) - 3),
        opacities=torch.rand(count, generator=g),
        colors=torch.randn(count, (degree + 1) ** 2, 3, generator=g),
    )
    share = torch.rand((), generator=g).item() ** 2
    for name, values in zip(NAMES, (PLACES, LENGTHS, SIZES, OPACITIES, HARMONICS), strict=True):
        _corrupt(g, getattr(cloud, name), values, 0.3 * share)
        if non_finite:
            _corrupt(g, getattr(cloud, name), NOT_FINITE, 0.02)
    if _chance(g, 0.1):
        _corrupt(g, cloud.colors, BRIGHT, 0.3 * share)
    if count:
        copies = torch.rand(count, generator=g) < 0.3 * share
        rows = torch.where(copies, torch.randint(count, (count,), generator=g), torch.arange(count))
        cloud = cloud.pick(rows)
    return cloud


def _corrupt(g: torch.Generator, values: Tensor, extremes: tuple[float, ...], share: float) -> None:
    """Write extreme values into single entries, and one value into whole rows."""
    rows = torch.rand(len(values), generator=g) < share / 2
    same = _picked(g, extremes, (len(values), *[1] * (values.dim() - 1))).expand(values.shape)
    values[rows] = same[rows]
    entries = torch.rand(values.shape, generator=g) < share / 4
    values[entries] = _picked(g, extremes, tuple(values.shape))[entries]


def _cameras(g: torch.Generator, views: int, width: int, height: int) -> tuple[Tensor, Tensor]:
    """Draw cameras around the cloud; in two of five scenes unusual ones."""
    viewmats, Ks = torch.eye(4).repeat(views, 1, 1), torch.eye(3).repeat(views, 1, 1)
    quats = torch.randn(views, 4, generator=g, dtype=torch.float64)
    viewmats[:, :3, :3] = quats_to_rotations(quats).float()
    odd = torch.rand(views, generator=g) < (0.7 if _chance(g, 0.4) else 0.0)

    def drawn(unusual: tuple[float, ...], usual: tuple[float, ...]) -> Tensor:
        return torch.where(odd, _picked(g, unusual, (views,)), _picked(g, usual, (views,)))

    viewmats[:, 2, 3] = drawn((3.0, 0.5, 0.0, 100.0, -3.0), (3.0,))
    focal = 0.5 * height / torch.tan(torch.deg2rad(drawn(FOVS_DEG, (40.0, 60.0))) / 2)
    Ks[:, 0, 0], Ks[:, 1, 1] = focal * (2.0 if _chance(g, 0.1) else 1.0), focal
    centre = drawn((0.5, 0.5, 0.0, -3.0, 20.0), (0.5,))
    Ks[:, 0, 2], Ks[:, 1, 2] = centre * width, centre * height
    return viewmats, Ks


def _options(g: torch.Generator, size: tuple[int, int]) -> dict[str, Any]:
    preset = ("fast", "balanced", "accurate")[int(torch.randint(3, (), generator=g))]
    options: dict[str, Any] = {"preset": preset, "near": _picked(g, NEAR, ()).item()}
    options |= {"antialias": _chance(g, 0.3), "absgrad": _chance(g, 0.3)}
    if size[0] % 2 == size[1] % 2 == 0 and _chance(g, 0.3):
        options["downsample"] = 2
    return options


def draw(scene: Scene, backend: str, dtype: torch.dtype = torch.float32) -> Run:
    """Render forward and backward with fixed cotangents."""
    leaves = scene.cloud.to(dtype).leaves()
    viewmats = scene.viewmats.to(dtype, copy=True).requires_grad_()
    background = scene.background
    background = None if background is None else background.to(dtype, copy=True).requires_grad_()
    positions = -torch.einsum("vij,vi->vj", viewmats[:, :3, :3], viewmats[:, :3, 3]).detach()
    directions = leaves.means.detach()[None] - positions[:, None]
    directions = torch.nn.functional.normalize(directions, dim=-1)
    view = viewmats, scene.Ks.to(dtype), *scene.size
    options = {"background": background, "backend": backend, **scene.options}
    out = rasterize(*leaves[:4], sh_to_colors(leaves.colors, directions), *view, **options)
    torch.autograd.backward([out.image, out.alpha, out.depth], cotangents(out))
    inputs = zip((*NAMES, "viewmats", "means2d"), (*leaves, viewmats, out.means2d), strict=True)
    grads = {name: leaf.grad for name, leaf in inputs}
    return Run(out, grads if background is None else grads | {"background": background.grad})


def fault(scene: Scene, drawn: Run) -> Optional[str]:
    """Return what isn't finite, or alpha outside [0, 1]; but radii may be infinite for a Gaussian
    larger than float32, and the gradient of SH coefficients NaN where the mean is.
    """
    for name in ("image", "alpha", "depth", "means2d", "contribution"):
        if not getattr(drawn.out, name).isfinite().all():
            return f"{name} isn't finite"
    if drawn.out.radii.isnan().any():
        return "radii are NaN"
    if not ((drawn.out.alpha >= 0) & (drawn.out.alpha <= 1 + 1e-5)).all():
        return "alpha isn't in [0, 1]"
    placed = scene.cloud.means.isfinite().all(1)
    if (scene.cloud.colors.abs() >= BRIGHT[0]).any():
        return None
    for name, grad in drawn.grads.items():
        if not (grad[placed] if name == "colors" else grad).isfinite().all():
            return f"the gradient of {name} isn't finite"
    return None


def disagreement(pictures: dict[str, Run]) -> Optional[str]:
    """Return which render of a well-posed scene differs from the last one by more than rounding."""
    *others, (first, one) = pictures.items()
    for name, other in others:
        for part in ("image", "alpha"):
            ours, theirs = (getattr(drawn.out, part).double() for drawn in (one, other))
            difference = (ours - theirs).abs().max()
            if difference > FLIPS * max(ours.abs().max().item(), 1.0):
                return f"{part} of {first} and {name} differ by {difference:.2g}"
        for part, grad in one.grads.items():
            if (distance := _distance(other.grads[part], grad)) > GRADIENTS:
                return f"gradients of {part} of {first} and {name}: {distance:.2g} of their length"
    return None


def fault_of(scene: Scene, backend: str) -> Optional[str]:
    return fault(scene, draw(scene, backend))


def disagreement_on(scene: Scene, backends: Sequence[str]) -> Optional[str]:
    """Return the disagreement of backends on a scene; the specification, in float64, comes last."""
    pictures = {name: draw(scene, name) for name in backends}
    return disagreement(pictures | {"float64": draw(scene, "reference", torch.float64)})


def _distance(a: Tensor, b: Tensor) -> float:
    a, b = (x.double().reshape(len(x), math.prod(x.shape[1:])) for x in (a, b))
    rows = (a - b).norm(dim=1)
    kept = rows.argsort()[: max(len(rows) * 99 // 100, len(rows) - 3 if len(rows) < 300 else 0)]
    return ((a - b)[kept].norm() / b.norm().clamp(min=1e-6)).item()
