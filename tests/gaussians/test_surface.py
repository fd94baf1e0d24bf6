"""The mesh of a cloud: closed, oriented outwards, at the Gaussians, with their colours."""

import numpy as np
import pytest

from tests.helpers.painted_ball import opaque_cloud
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.surface import gaussian_surface, surface_nets

trimesh = pytest.importorskip("trimesh")
CENTER = np.array([0.3, 0.0, -0.2])


def ball(count=4000, scale=0.02, hollow=True):
    """Return Gaussians on, or in, a sphere, coloured by position."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(count, 3))
    share = 1 if hollow else rng.random((count, 1)) ** (1 / 3)
    points *= 0.5 * share / np.linalg.norm(points, axis=1, keepdims=True)
    return opaque_cloud(points + CENTER, points.clip(-0.5, 0.5) + 0.5, scale, 0.98)


def as_mesh(surface):
    return trimesh.Trimesh(surface.vertices, surface.faces, process=False)


def distances(surface):
    return np.linalg.norm(surface.vertices - CENTER, axis=1)


def test_surface_nets_of_a_sphere_and_of_a_turned_disc():
    """Linear interpolation of a distance is exact to second order in the cell size."""
    axes = np.meshgrid(*[np.linspace(-1, 1, 33)] * 3, indexing="ij")
    vertices, faces = surface_nets(0.7 - np.sqrt(sum(axis**2 for axis in axes)), 0.0)
    mesh = trimesh.Trimesh(vertices / 16 - 1, faces, process=False)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.euler_number == 2
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 0.7**3, rel=0.02)
    np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 0.7, atol=0.01)
    half = np.deg2rad(45 / 2)
    disc = Gaussians(
        means=np.zeros((1, 3), np.float32),
        sh=np.zeros((1, 1, 3), np.float32),
        logit_opacities=np.float32([4.0]),
        log_scales=np.log(np.float32([[0.5, 0.5, 0.02]])),
        quats=np.float32([[np.cos(half), 0, -np.sin(half), 0]]),
    )
    vertices = gaussian_surface(disc, resolution=96).vertices
    # as far as exp(-1/2 (r / s)^2) is a half, with s that of the disc and a cell
    reach = np.sqrt(2 * np.log(2)) * np.hypot([0.5, 0.02], 1 / 96)
    assert np.abs(vertices[:, 1]).max() == pytest.approx(reach[0], abs=0.02)
    along, across = (np.sqrt(0.5) * np.array([1, 0, sign]) for sign in (1, -1))
    assert np.abs(vertices @ along).max() == pytest.approx(reach[0], abs=0.02)
    assert np.abs(vertices @ across).max() == pytest.approx(reach[1], abs=0.01)


def test_a_solid_ball_is_one_closed_surface():
    surface = gaussian_surface(ball(count=4000, scale=0.04, hollow=False), resolution=32)
    mesh = as_mesh(surface)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.volume > 0
    # half of the density at the middle is at the ball's own radius, blurred by the Gaussians' size
    assert distances(surface).mean() == pytest.approx(0.5, abs=0.03)
    arrays = ball()
    far = arrays._replace(means=arrays.means + 5, logit_opacities=arrays.logit_opacities - 10)
    both = Gaussians(*(np.concatenate(pair) for pair in zip(arrays, far, strict=True)))
    found, wanted = (gaussian_surface(each, resolution=24).vertices for each in (both, arrays))
    np.testing.assert_array_equal(found, wanted)
    assert len(gaussian_surface(far).faces) == 0


@pytest.mark.parametrize(("count", "scale"), [(4000, 0.02), (16000, 0.002)])
def test_the_surface_is_at_the_gaussians_for_any_overlap(count, scale):
    """Within 1.2 standard deviations of the Gaussians and a cell."""
    surface = gaussian_surface(ball(count, scale=scale), resolution=64)
    spread = np.hypot(scale, 1 / 64)
    away = np.abs(distances(surface) - 0.5)
    assert 0.5 * spread < np.median(away) < 1.5 * spread and away.max() < 3 * spread
    wanted = (surface.vertices - CENTER + 0.5).clip(0, 1)
    np.testing.assert_allclose(surface.colors, wanted, atol=0.08)
