"""Fused depths give back the surface that they were cast from."""

import math

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.cameras import Orbit, ray_directions, to_opencv
from threestudio_gaussiandreamer.surface.fusion import DepthFusion

SIZE, RADIUS = 96, 0.7


def traced(c2w, fovy, size, radius):
    """Return the exact depth (B, size, size) and opacity of a ball around the origin."""
    rays = ray_directions(c2w, fovy, size, size, normalize=False)
    origin = c2w[:, None, None, :3, 3]
    a, b = rays.square().sum(-1), (rays * origin).sum(-1)
    root = b.square() - a * (origin.square().sum(-1) - radius**2)
    alpha = (root > 0).float()
    return alpha * (-b - root.clamp_min(0).sqrt()) / a, alpha


def views_of_a_ball(elevations):
    """Yield cameras with the exact depth and opacity of a ball around the origin."""
    count = len(elevations)
    fovy = torch.full((count,), math.radians(50))
    azimuth = torch.arange(count) * 137.5
    c2w = Orbit(torch.tensor(elevations), azimuth, torch.full((count,), 2.5), fovy).c2w
    depth, alpha = traced(c2w, fovy, SIZE, RADIUS)
    viewmats, Ks = to_opencv(c2w, fovy, SIZE, SIZE)
    yield from zip(viewmats, Ks, depth, torch.zeros_like(depth), alpha, strict=True)


def fused(views, resolution=32):
    fusion = DepthFusion(-torch.full((3,), RADIUS), torch.full((3,), RADIUS), resolution)
    for view in views:
        fusion.add(*view)
    return fusion


def radii(fusion):
    index = np.stack(np.meshgrid(*map(np.arange, fusion.shape), indexing="ij"), axis=-1)
    return np.linalg.norm(index * fusion.cell + fusion.origin.numpy(), axis=-1)


def test_the_distance_is_zero_at_the_surface_and_what_no_view_sees_is_inside():
    fusion = fused(views_of_a_ball([-60.0, -30, 0, 15, 30, 60, -15, 45, 75, -75, 5, -45]))
    field, distance = fusion.field(), radii(fusion) - RADIUS
    assert (field[distance > fusion.cell] > 0).all()
    assert (field[distance < -fusion.cell] < 0).all()
    across = field[:, field.shape[1] // 2, field.shape[2] // 2]
    assert (np.diff(across[: len(across) // 2]) <= 1e-3).all()  # falls towards the middle
    field = fused(views_of_a_ball([60.0, 70, 80])).field()  # the underside is never seen
    x, y, z = (n // 2 for n in field.shape)
    assert field[x, y, z] < 0 and field[x, y, 4] < 0
    for axis in range(3):
        assert (np.take(field, [0, -1], axis=axis) == 1).all()
    views = list(views_of_a_ball([0.0, 20, 40, -20, -40]))
    wrong = [
        (viewmat, K, depth - 0.2 * alpha, torch.full_like(depth, 1.0), alpha)
        for viewmat, K, depth, _, alpha in views
    ]
    fusion, right = fused([*views, *wrong]), fused(views).field()
    near = np.abs(radii(fusion) - RADIUS) < fusion.cell
    assert np.abs(fusion.field()[near] - right[near]).mean() < 0.05


@pytest.mark.parametrize("alpha", [0.3, 0.6])
def test_outlines_are_at_half_the_opacity(alpha):
    views = [(*view[:4], alpha * view[4]) for view in views_of_a_ball([0.0, 30, -30, 60])]
    assert (fused(views, 16).field() < 0).any() == (alpha > 0.5)
