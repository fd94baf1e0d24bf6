"""On images of exactly M Gaussians, starting from 4 M with duplicates and floaters, `budget: auto`
keeps at most 1.2 M.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.sh import rgb_to_sh0
from threestudio_gaussiandreamer.gaussians.views import psnr_to_original, render_all, views_around
from threestudio_gaussiandreamer.splatting import rasterize
from threestudio_gaussiandreamer.training.density import DensityControl
from threestudio_gaussiandreamer.training.geometry import GaussianCloud

M, SIZE, STEPS = 80, 64, 600
RATES = {
    "lr_means": [0, 2e-4, 2e-5, STEPS],
    "lr_scales": [0, 6e-2, 1e-3, STEPS],
    "lr_quats": [0, 6e-2, 2e-3, STEPS],
    "lr_opacities": [0, 1e-1, 5e-3, STEPS],
    "lr_sh": [0, 1e-1, 2e-3, STEPS],
}
"""Those of configs/demo.yaml."""


def torus(count: int, seed: int) -> Gaussians:
    """Return flat Gaussians of random colours on a torus, each of which is visible from
    somewhere.
    """
    rng = torch.Generator().manual_seed(seed)
    u, v = 2 * math.pi * torch.rand(2, count, generator=rng)
    normals = torch.stack([u.cos() * v.cos(), u.sin() * v.cos(), v.sin()], 1)
    ring = torch.stack([u.cos(), u.sin(), torch.zeros(count)], 1)
    size = 0.5 * math.sqrt(4 * math.pi**2 * 0.7 * 0.3 / count)
    noise = 0.3 * torch.randn(count, 3, generator=rng)
    log_scales = torch.tensor([size, size, 0.2 * size]).log() + noise
    # half a turn around the bisector takes +z to the normal
    bisectors = torch.nn.functional.normalize(normals + torch.tensor([0, 0, 1.0]), dim=1)
    quats = torch.cat([torch.zeros(count, 1), bisectors], 1)
    opacities = 0.6 + 0.35 * torch.rand(count, generator=rng)
    means = 0.7 * ring + 0.3 * normals
    return Gaussians(means, quats, log_scales, opacities.logit(), colored(count, rng))


def colored(count: int, rng: torch.Generator) -> Float[Tensor, "N 1 3"]:
    return rgb_to_sh0(torch.rand(count, 1, 3, generator=rng))


def floaters(count: int, seed: int) -> Gaussians:
    """Return Gaussians like those of the torus, uniformly in a box without cameras."""
    rng = torch.Generator().manual_seed(1000 + seed)
    means = 1.6 * torch.rand(count, 3, generator=rng) - 0.8
    return torus(count, seed + 1)._replace(means=means, sh=colored(count, rng))


def mixed(clouds: list[Gaussians], seed: int) -> Gaussians:
    """Join clouds in random order."""
    together = Gaussians(*(torch.cat(values) for values in zip(*clouds, strict=True)))
    order = torch.randperm(len(together.means), generator=torch.Generator().manual_seed(seed))
    return together.rows(order)


def with_copies_and_floaters(true: Gaussians, seed: int) -> Gaussians:
    """Add copies, moved by about a third of the thinnest axis, and floaters as opaque as
    the rest.
    """
    rng = torch.Generator().manual_seed(seed)
    thinnest = true.log_scales.exp().amin(1, keepdim=True)
    shifts = (0.3 * thinnest * torch.randn(true.means.shape, generator=rng) for _ in range(2))
    moved = [true._replace(means=true.means + shift) for shift in shifts]
    return mixed([true, *moved, floaters(len(true.means), seed)], seed)


def trained(geometry, views, pictures):
    """Fit a cloud to the images for a short run: the system's steps without its host."""
    adam = torch.optim.Adam(geometry.parameter_groups(), betas=(0.9, 0.99), eps=1e-15)
    rng = torch.Generator().manual_seed(0)

    def draw(rows, opacities):
        colors = geometry.colors(views.positions[rows])
        cloud = geometry.means, geometry.quats, geometry.scales(), opacities, colors
        camera = views.viewmats[rows], views.Ks[rows]
        return rasterize(*cloud, *camera, SIZE, SIZE, background=views.backgrounds[rows])

    control = DensityControl(geometry)
    for step in range(1, STEPS + 1):
        geometry.set_learning_rates(adam, 0, step)
        rows = torch.randperm(len(pictures), generator=rng)[:4]
        opacities = geometry.opacities()
        out = draw(rows, opacities)
        behind = views.backgrounds[rows][:, None, None]
        pictures_now = {
            "comp_rgb": out.image,
            "opacity": out.alpha,
            "comp_rgb_bg": behind,
            "gaussian_opacities": opacities,
        }
        error = (out.image.detach() - pictures[rows]).square().mean()
        control.before_backward(pictures_now, step - 1, lambda error=error: error)
        (0.5 * (out.image - pictures[rows]).square().sum() / 4).backward()
        control.after_backward(out, SIZE, SIZE)
        adam.step()
        adam.zero_grad(set_to_none=True)
        control.after_step(adam, step)
    return Gaussians.of(geometry)


def test_auto_finds_the_true_number_with_visible_floaters_and_copies():
    true = torus(M, 0)
    start = with_copies_and_floaters(true, 0)
    views, unseen = (
        views_around(true, count, SIZE, turn=turn) for count, turn in ((48, 0.0), (16, 60.0))
    )
    truth = render_all(true, unseen)
    assert len(start.means) == 4 * M and psnr_to_original(start, unseen, truth) < 24
    schedule = {"start": STEPS // 12, "stop": STEPS * 3 // 4, "every": STEPS // 24}
    geometry = GaussianCloud({"budget": "auto", "min_gaussians": 8, "prune": schedule, **RATES})
    geometry.set_arrays(**start._asdict())
    geometry.merge_duplicates()
    assert len(geometry) < 2.2 * M
    found = trained(geometry, views, render_all(true, views))
    assert M <= len(found.means) <= 1.2 * M
    assert psnr_to_original(found, unseen, truth) >= 40
