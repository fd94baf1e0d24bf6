"""Of M Gaussians' images, from 4 M with duplicates and floaters, `auto` keeps at most 1.2 M."""

import math

import torch

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


def colored(rng: torch.Generator) -> torch.Tensor:
    return rgb_to_sh0(torch.rand(M, 1, 3, generator=rng))


def torus(seed: int) -> Gaussians:
    """Return flat Gaussians of random colours on a torus, each visible from somewhere."""
    rng = torch.Generator().manual_seed(seed)
    u, v = 2 * math.pi * torch.rand(2, M, generator=rng)
    normals = torch.stack([u.cos() * v.cos(), u.sin() * v.cos(), v.sin()], 1)
    ring = torch.stack([u.cos(), u.sin(), torch.zeros(M)], 1)
    size = 0.5 * math.sqrt(4 * math.pi**2 * 0.7 * 0.3 / M)
    log_scales = torch.tensor([size, size, 0.2 * size]).log()
    log_scales = log_scales + 0.3 * torch.randn(M, 3, generator=rng)
    # half a turn around the bisector takes +z to the normal
    bisectors = torch.nn.functional.normalize(normals + torch.tensor([0, 0, 1.0]), dim=1)
    quats = torch.cat([torch.zeros(M, 1), bisectors], 1)
    opacities = 0.6 + 0.35 * torch.rand(M, generator=rng)
    means = 0.7 * ring + 0.3 * normals
    return Gaussians(means, quats, log_scales, opacities.logit(), colored(rng))


def with_copies_and_floaters(true: Gaussians) -> Gaussians:
    """Add copies, moved by a third of the thinnest axis, and floaters, in random order."""
    rng = torch.Generator().manual_seed(0)
    thinnest = true.log_scales.exp().amin(1, keepdim=True)
    shifts = [0.3 * thinnest * torch.randn(M, 3, generator=rng) for _ in range(2)]
    rng = torch.Generator().manual_seed(1000)
    means = 1.6 * torch.rand(M, 3, generator=rng) - 0.8
    floaters = torus(1)._replace(means=means, sh=colored(rng))
    clouds = true, *(true._replace(means=true.means + shift) for shift in shifts), floaters
    order = torch.randperm(4 * M, generator=torch.Generator().manual_seed(0))
    return Gaussians(*(torch.cat(values)[order] for values in zip(*clouds, strict=True)))


def trained(geometry, views, pictures):
    """Fit a cloud to the images for a short run: the system's steps without its host."""
    adam = torch.optim.Adam(geometry.parameter_groups(), betas=(0.9, 0.99), eps=1e-15)
    rng = torch.Generator().manual_seed(0)

    control = DensityControl(geometry)
    for step in range(1, STEPS + 1):
        geometry.set_learning_rates(adam, 0, step)
        rows = torch.randperm(len(pictures), generator=rng)[:4]
        opacities = geometry.opacities()
        shape, colors = (geometry.means, geometry.quats), geometry.colors(views.positions[rows])
        camera, behind = (views.viewmats[rows], views.Ks[rows], SIZE, SIZE), views.backgrounds[rows]
        cloud = *shape, geometry.scales(), opacities, colors
        out = rasterize(*cloud, *camera, background=behind)
        seen = {"comp_rgb": out.image, "opacity": out.alpha, "gaussian_opacities": opacities}
        error = (out.image.detach() - pictures[rows]).square().mean()
        seen["comp_rgb_bg"] = behind[:, None, None]
        control.before_backward(seen, step - 1, lambda error=error: error)
        (0.5 * (out.image - pictures[rows]).square().sum() / 4).backward()
        control.after_backward(out, SIZE, SIZE)
        adam.step()
        adam.zero_grad(set_to_none=True)
        control.after_step(adam, step)
    return Gaussians.of(geometry)


def test_auto_finds_the_true_number_with_visible_floaters_and_copies():
    true = torus(0)
    start = with_copies_and_floaters(true)
    views, unseen = (views_around(true, n, SIZE, turn=t) for n, t in ((48, 0.0), (16, 60.0)))
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
