"""Noise attached to surfaces: standard normal in each view, the same in all views."""

import math

import torch

from threestudio_gaussiandreamer.cameras import orbit_c2w, ray_directions
from threestudio_gaussiandreamer.diffusion.consistent_noise import (
    SAMPLES,
    TABLE,
    attach_noise,
    surface_points,
)

FOVY = math.radians(50)


def ball(azimuths, size, distance=3.0):
    """Return depth and opacity of a unit ball at the origin, ray traced, and its cameras."""
    count = len(azimuths)
    values = torch.full((count,), 15.0), torch.tensor(azimuths), torch.full((count,), distance)
    c2w = orbit_c2w(*values)
    half = math.tan(FOVY / 2)
    grid = (torch.arange(size) + 0.5) / size * 2 - 1
    y, x = torch.meshgrid(-grid * half, grid * half, indexing="ij")
    rays = torch.stack([x, y, torch.full_like(x, -1.0)], -1)
    # |position + s ray| = 1 with the ball's centre at distance along the view direction
    a, b = rays.square().sum(-1), -distance * torch.ones_like(x)
    root = b**2 - a * (distance**2 - 1)
    hit = root > 0
    s = torch.where(hit, (-b - root.clamp_min(0).sqrt()) / a, torch.zeros_like(a))
    images = [image[None, ..., None].expand(count, -1, -1, -1) for image in (s, hit.float())]
    return *images, c2w, torch.full((count,), FOVY)


def table(seed=0, channels=4):
    return torch.randn(TABLE, channels, generator=torch.Generator().manual_seed(seed))


def image_noise(views, size, seed=1, channels=4):
    return torch.randn(views, channels, size, size, generator=torch.Generator().manual_seed(seed))


def test_points_lie_on_the_surface():
    depth, opacity, c2w, fovy = ball([0.0, 70.0], 64)
    points = torch.stack(surface_points(depth[..., 0], c2w, fovy), -1)
    inside = opacity[..., 0] > 0
    assert inside.float().mean() > 0.2
    torch.testing.assert_close(
        points[inside].norm(dim=-1), torch.ones(int(inside.sum())), rtol=0, atol=1e-5
    )
    rays = ray_directions(c2w, fovy, 64, 64, normalize=False)
    torch.testing.assert_close(points, c2w[:, None, None, :3, 3] + depth * rays)


def test_pixels_are_standard_normal_and_hardly_correlated():
    size, samples = 32, []
    view = ball([20.0], 128)
    for seed in range(200):
        samples.append(attach_noise(image_noise(1, size, seed), table(seed), *view)[0, 0])
    noise = torch.stack(samples)
    # of 200 seeds and 1024 pixels: 5 standard deviations of a mean and of a variance
    assert abs(float(noise.mean())) < 5 / (200 * size**2 / 4) ** 0.5
    assert abs(float(noise.var()) - 1) < 0.03
    neighbours = (noise[:, :, 1:] * noise[:, :, :-1]).mean(0)[8:24, 8:24]
    # the nearest points of two pixels share a cell with a probability of at most a half
    assert abs(float(neighbours.mean())) < 0.25


def test_near_views_see_the_same_noise_and_far_views_do_not():
    size, view = 32, ball([0.0, 0.0, 0.5, 90.0], 128)
    noise = attach_noise(image_noise(4, size), table(), *view)
    centre = noise[:, :, 12:20, 12:20].flatten(1)
    correlation = torch.corrcoef(centre)
    assert torch.equal(centre[0], centre[1])
    assert correlation[0, 2] > 0.5 and abs(correlation[0, 3]) < 0.2
    independent = image_noise(4, size)[:, :, 12:20, 12:20].flatten(1)
    assert abs(torch.corrcoef(independent)[0, 2]) < 0.2


def test_the_background_keeps_the_noise_of_the_image():
    size, view = 32, ball([0.0, 40.0], 128)
    plain = image_noise(2, size)
    noise = attach_noise(plain, table(), *view)
    corner = (slice(None), slice(None), slice(0, 4), slice(0, 4))
    assert torch.equal(noise[corner], plain[corner])
    assert not torch.equal(noise[:, :, 16, 16], plain[:, :, 16, 16])


def test_points_of_one_cell_count_as_one_value():
    """Seen from very near, all points of a pixel may lie in one cell: still variance 1
    (five deviations of it are 0.2)."""
    depth, opacity = torch.full((1, 8, 8, 1), 0.1), torch.ones(1, 8, 8, 1)
    c2w, fovy = orbit_c2w(*torch.tensor([[10.0], [20.0], [3.0]])), torch.tensor([0.5])
    values = [
        attach_noise(image_noise(1, 4, seed), table(seed), depth, opacity, c2w, fovy)
        for seed in range(300)
    ]
    assert SAMPLES == 2 and abs(float(torch.stack(values).var()) - 1) < 0.2
