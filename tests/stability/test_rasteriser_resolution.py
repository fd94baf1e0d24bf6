"""Rendering at other resolutions and depth orders."""

import math

import torch

from tests.helpers.splatting_draws import draw
from tests.helpers.splatting_scenes import (
    cameras,
    front_camera,
    one_gaussian,
    psnr,
    random_cloud,
    rasterize,
)
from tests.stability.backends import each_backend
from tests.stability.rows import row

TILTED = torch.tensor([[0.9, 0.2, 0.1, 0.4]], dtype=torch.float64)


# ---- resolution and order ------------------------------------------------------------------------


@row("A1", "Anti-aliasing across resolutions")
@each_backend
def test_energy_of_a_small_gaussian_with_distance(backend, measured):
    """The sum of alpha times z^2, which is constant for a Gaussian that only moves away."""
    energies = {}
    for antialias in (False, True):
        options = {"alpha_min": 1e-6, "antialias": antialias}
        clouds = [(z, one_gaussian((0.0, 0.0, z), 0.05)) for z in (2.0, 4.0, 8.0, 16.0, 32.0)]
        drawn = [
            draw(backend, cloud, front_camera(64, 64, 60.0), 64, 64, **options).out.alpha.sum()
            * z**2
            for z, cloud in clouds
        ]
        energies[antialias] = torch.stack(drawn)
    drift = {flag: ((x.max() - x.min()) / x.mean() * 100).item() for flag, x in energies.items()}
    measured(drift[True], "%", what="drift", at_most=5)
    measured(drift[False], "%", what="classic drift")


@row("A1", "Anti-aliasing across resolutions")
@each_backend
def test_antialiasing_of_a_cloud_of_subpixel_gaussians(backend, measured):
    """A small render, against the box average of one 16 times larger, in which every Gaussian
    covers pixels.
    """
    cloud = random_cloud(3000, seed=2, size=0.006, stretch=0.3)
    with torch.no_grad():
        large = rasterize(
            *cloud.to(torch.float32), *cameras(1, 512, 512, dtype=torch.float32), 512, 512
        ).image
    truth = large.reshape(1, 32, 16, 32, 16, 3).mean((2, 4))
    quality = {
        a: psnr(draw(backend, cloud, cameras(1, 32, 32), 32, 32, antialias=a).out.image, truth)
        for a in (False, True)
    }
    measured(quality[True] - quality[False], "dB", what="better than classic", at_least=10)


@row("A1", "Popping")
@each_backend
def test_popping_is_one_jump_of_the_analytic_size(backend, measured):
    """Two crossing discs of opposite colours whose means swap their depth order as the camera turns
    by 0.01 degrees per frame.
    """
    a1, a2 = 0.6, 0.7
    colors = torch.tensor([[1.0, 0, 0], [0, 0, 1.0]])
    flat = random_cloud(2)._replace(
        means=torch.tensor([[0.1, 0.0, 0.0], [-0.1, 0.0, 0.0]]).double(),
        scales=torch.full((2, 3), 0.5).double(), quats=TILTED.repeat(2, 1),
        opacities=torch.tensor([a1, a2]).double(), colors=colors.double(),
    )  # fmt: skip

    def frame(degrees: float) -> torch.Tensor:
        angle, viewmat = math.radians(degrees), torch.eye(4)
        viewmat[0, 0] = viewmat[2, 2] = math.cos(angle)
        viewmat[0, 2], viewmat[2, 0], viewmat[2, 3] = math.sin(angle), -math.sin(angle), 3.0
        return draw(backend, flat, (viewmat[None], front_camera(24, 24, 20.0)[1]), 24, 24).out.image

    frames = [frame(0.005 + 0.01 * k) for k in range(-5, 5)]
    jumps = torch.stack([(b - a).abs().max() for a, b in zip(frames, frames[1:], strict=False)])
    measured(jumps.max() / (a1 * a2), "of a1 a2 |c1 - c2|", what="jump", at_most=1 + 1e-3)
    measured((jumps > 0.01).sum(), "frames", what="duration of the jump", at_most=1)
    assert (jumps > 0.01).sum() == 1
