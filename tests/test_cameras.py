"""The conventions, checked against computed geometry."""

import math

import pytest
import torch

from threestudio_gaussiandreamer import cameras
from threestudio_gaussiandreamer.cameras import Orbit, OrbitRanges
from threestudio_gaussiandreamer.core.streams import generator


def view(elevation=0.0, azimuth=0.0, distance=2.0, fovy=60.0):
    return Orbit(*(torch.tensor([v]) for v in (elevation, azimuth, distance, math.radians(fovy))))


def project(point, orbit, height, width):
    viewmats, Ks = cameras.to_opencv(orbit.c2w, orbit.fovy, height, width)
    t = viewmats[0, :3, :3] @ torch.tensor(point) + viewmats[0, :3, 3]
    pixel = Ks[0] @ (t / t[2])
    return pixel[:2], t[2]


@pytest.mark.parametrize(
    "elevation, azimuth, position",
    [
        *((0, 0, (2, 0, 0)), (0, 90, (0, 2, 0)), (30, 180, (-math.sqrt(3), 0, 1))),
        *((90, 0, (0, 0, 2)), (90, 30, (0, 0, 2)), (-90, 30, (0, 0, -2))),
    ],
)
def test_azimuth_0_is_plus_x_90_is_plus_y_and_z_is_up(elevation, azimuth, position):
    c2w = view(elevation, azimuth).c2w
    assert torch.allclose(c2w[0, :3, 3], torch.tensor(position, dtype=torch.float32), atol=1e-6)
    assert torch.allclose(c2w[0, :3, :3].T @ c2w[0, :3, :3], torch.eye(3), atol=1e-6)
    assert torch.linalg.det(c2w[0, :3, :3]) > 0.999


def test_the_front_camera_sees_y_to_the_right_and_z_up():
    pixel, depth = project([0.0, 0.5, 0.0], view(), 100, 200)
    assert pixel[0] > 100 and pixel[1] == pytest.approx(50, abs=1e-4)
    assert depth == pytest.approx(2.0)
    pixel, _ = project([0.0, 0.0, 0.5], view(), 100, 200)
    assert pixel[0] == pytest.approx(100, abs=1e-4) and pixel[1] < 50  # row 0 is on top
    # the vertical field of view spans the height, and pixels are square
    half = 2.0 * math.tan(math.radians(30))
    pixel, _ = project([0.0, 0.0, half], view(), 100, 200)
    assert pixel[1] == pytest.approx(0.0, abs=1e-3)
    pixel, _ = project([0.0, half, 0.0], view(), 100, 200)
    assert pixel[0] == pytest.approx(150.0, abs=1e-3)  # as many pixels sideways as upwards


def test_rays_through_pixel_centres_agree_with_the_projection():
    orbit = view(20.0, 40.0)
    rays = cameras.ray_directions(orbit.c2w, orbit.fovy, 6, 8)
    assert torch.allclose(rays.norm(dim=-1), torch.ones(1, 6, 8), atol=1e-6)
    point = orbit.c2w[0, :3, 3] + 1.7 * rays[0, 4, 2]
    pixel, _ = project(point.tolist(), orbit, 6, 8)
    assert torch.allclose(pixel, torch.tensor([2.5, 4.5]), atol=1e-4)


def test_the_host_projection_matrix_puts_the_top_row_at_minus_one():
    orbit = view()
    top = torch.tensor([0.0, 0.0, 2 * math.tan(math.radians(30)), 1.0])
    clip = cameras.projection(orbit.fovy, 2.0)[0] @ torch.linalg.inv(orbit.c2w)[0] @ top
    assert (clip[1] / clip[3]).item() == pytest.approx(-1.0, abs=1e-5)


def test_sampled_views_stay_in_the_papers_ranges_and_cover_the_circle():
    ranges = OrbitRanges()
    for step in range(50):
        orbit = cameras.sample_orbit(4, ranges, generator(0, "camera", step))
        for values, low, high in (
            (orbit.elevation, -10.001, 60.001),
            (orbit.distance, 1.5, 4.0),
            (torch.rad2deg(orbit.fovy), 40, 70.001),
        ):
            assert (values >= low).all() and (values <= high).all()
        assert sorted(((orbit.azimuth + 180) // 90).tolist()) == [0, 1, 2, 3]


def test_held_out_views_are_fixed_distinct_and_in_no_pool():
    held_out, pool = cameras.held_out_orbit(24), cameras.camera_pool(200, OrbitRanges(), 0)
    assert len(held_out.c2w.flatten(1).unique(dim=0)) == 24
    assert torch.cdist(held_out.c2w.flatten(1), pool.c2w.flatten(1)).min() > 1e-3


def test_every_pool_mixes_both_elevation_rules_and_covers_all_azimuths():
    """Uniform in angle and in the sine, half each; a pool of one rule differs from that by 0.05."""
    ranges = OrbitRanges(elevation=(-90.0, 90.0))
    for seed in range(8):
        elevation = cameras.camera_pool(20_000, ranges, seed).elevation.double()
        by_angle, by_sine = (elevation + 90) / 180, (torch.deg2rad(elevation).sin() + 1) / 2
        shares = (by_angle + by_sine).sort().values / 2
        assert (shares - torch.linspace(0, 1, len(shares)).double()).abs().max() < 0.015
    pool = cameras.camera_pool(200, OrbitRanges(), 3)
    assert (pool.azimuth.diff() > -2).all()
    assert pool.azimuth.min() < -175 and pool.azimuth.max() > 175
    assert torch.equal(pool.distance, cameras.camera_pool(200, OrbitRanges(), 3).distance)
    assert not torch.equal(pool.distance, cameras.camera_pool(200, OrbitRanges(), 4).distance)


def test_the_inverse_of_a_camera_is_exact_and_an_invalid_one_affects_only_itself():
    orbits = torch.tensor([[10.0, 90.0, 0.0], [20.0, 0.0, 0.0], [2.0, 3.0, 4.0]])
    c2w = cameras.orbit_c2w(*orbits)
    inverse = torch.linalg.inv(c2w)
    torch.testing.assert_close(cameras.world_to_camera(c2w), inverse, rtol=0, atol=1e-5)
    whole = cameras.world_to_camera(c2w[:1])
    c2w[1], c2w[2] = torch.nan, 0.0  # torch.linalg.inv raises, for all of them
    assert torch.equal(cameras.world_to_camera(c2w)[:1], whole)


def test_cameras_for_the_rasteriser_have_gradients_after_a_call_without():
    """Constants are kept from the first call."""
    cameras._constant.cache_clear()
    c2w = cameras.orbit_c2w(torch.tensor([10.0]), torch.tensor([20.0]), torch.tensor([2.0]))
    with torch.inference_mode():
        viewmats, Ks = cameras.to_opencv(c2w, torch.tensor([0.8]), 48, 64)
    again = cameras.to_opencv(c2w.requires_grad_(), torch.tensor([0.8], requires_grad=True), 48, 64)
    assert torch.equal(viewmats, again[0]) and torch.equal(Ks, again[1])
    sum(x.sum() for x in again).backward()
    assert c2w.grad.abs().sum() > 0


def test_a_camera_at_the_centre_has_the_direction_of_one_in_front():
    up = torch.tensor([[0.0, 0.0, 1.0]])
    center = cameras.look_at(torch.zeros(1, 3), torch.zeros(1, 3), up)
    front = cameras.look_at(torch.tensor([[2.0, 0.0, 0.0]]), torch.zeros(1, 3), up)
    assert torch.equal(center[:, :3, :3], front[:, :3, :3])
