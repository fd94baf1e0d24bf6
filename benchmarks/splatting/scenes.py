"""The six scenes on which the rasteriser's error is measured."""

from pathlib import Path

import torch

from benchmarks.splatting.bench_scenes import Scene, make_scene
from threestudio_gaussiandreamer.formats.ply import read_gaussians
from threestudio_gaussiandreamer.gaussians.grow import nearest_distance_scales
from threestudio_gaussiandreamer.gaussians.sh import sh0_to_rgb

TRAINED = Path(__file__).resolve().parents[1] / "scenes/trained.ply"


def scenes() -> dict[str, Scene]:
    return {
        "initial": initial(),
        "trained": trained(),
        "fog": fog(),
        "needles": needles(),
        "deep": deep(),
        "near plane": near(),
    }


def initial(count: int = 4000) -> Scene:
    """A cloud as a prior gives it: points on a surface, opacity 0.1, isotropic, as large as the
    distance to the next.
    """
    scene = make_scene(count)
    sizes = torch.from_numpy(nearest_distance_scales(scene.means.numpy(), "nearest"))
    return scene._replace(
        scales=sizes[:, None].repeat(1, 3).float(), opacities=torch.full((count,), 0.1)
    )


def trained() -> Scene:
    """The bundled toy after `make demo-exact` at 128^2 with 2,500 Gaussians."""
    cloud = read_gaussians(TRAINED)
    tensors = {
        name: torch.as_tensor(getattr(cloud, name)).float()
        for name in ("means", "quats", "log_scales", "logit_opacities", "sh")
    }
    colors = sh0_to_rgb(tensors["sh"][:, 0]).clamp_min(0)
    return Scene(
        tensors["means"],
        tensors["quats"],
        tensors["log_scales"].exp(),
        tensors["logit_opacities"].sigmoid(),
        colors,
    )


def blob(count: int, spread: float, size: float, opacity: float, seed: int) -> Scene:
    """Gaussians of one size and opacity in a ball."""
    rng = torch.Generator().manual_seed(seed)
    means, quats = (
        torch.randn(count, 3, generator=rng) * spread,
        torch.randn(count, 4, generator=rng),
    )
    return Scene(
        means,
        quats,
        torch.full((count, 3), size),
        torch.full((count,), opacity),
        torch.rand(count, 3, generator=rng),
    )


def fog() -> Scene:
    """2,000 Gaussians, each of them below the usual alpha threshold."""
    return blob(2000, 0.3, 0.2, 0.0038, 1)


def needles() -> Scene:
    """100 times longer than thick."""
    return blob(3000, 0.4, 0.002, 0.8, 2)._replace(
        scales=torch.tensor([0.2, 0.002, 0.002]).repeat(3000, 1)
    )


def deep() -> Scene:
    """10,000 Gaussians along one ray, opacities from 0.01 to 0.9."""
    scene = blob(10_000, 0.05, 0.05, 0.5, 3)
    scene.means[:, 0] = torch.linspace(-1, 1, 10_000)
    return scene._replace(
        opacities=torch.linspace(0.01, 0.9, 10_000)[
            torch.randperm(10_000, generator=torch.Generator().manual_seed(3))
        ]
    )


def near() -> Scene:
    """A cloud that surrounds the camera: some Gaussians are behind it, some intersect its near
    plane.
    """
    return blob(3000, 1.5, 0.03, 0.5, 4)
