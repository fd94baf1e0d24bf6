"""Clouds become closed textured meshes that look like them; what can't be converted is refused."""

import dataclasses
import sys

import numpy as np
import pytest
import torch
import trimesh

from tests.helpers.painted_ball import painted_ball, sphere_points
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians
from threestudio_gaussiandreamer.gaussians.views import FOVY, rasterize_views, views_around
from threestudio_gaussiandreamer.meshes.raycast import MeshCaster
from threestudio_gaussiandreamer.meshes.write import welded
from threestudio_gaussiandreamer.surface import fusion, textured
from threestudio_gaussiandreamer.surface.closed import is_closed
from threestudio_gaussiandreamer.surface.textured import MeshOptions, mesh_from_gaussians

SMALL = MeshOptions(faces=600, texture=128, views=16, view_size=128, resolution=32)


def closed(mesh):
    return is_closed(welded(mesh).rows[mesh.faces])


def psnr_to_cloud(mesh, gaussians, size=128):
    """Return the PSNR of the mesh's views to the cloud's, over white, dB."""
    cloud = gaussians.tensors()
    views = views_around(cloud, 12, size, turn=33, distances=(1.2,))
    rows, white = torch.arange(12), torch.ones(3)
    truth = rasterize_views(cloud, views, rows, white).image.numpy()
    cameras = [(c2w, FOVY) for c2w in fusion.opengl(views)]
    ours = MeshCaster(mesh).render_views(cameras, size, size)
    error = np.square(ours[..., :3] + 1 - ours[..., 3:] - truth).mean()
    return -10 * np.log10(error)


@pytest.mark.parametrize("method", ["fusion", "density"])
def test_a_ball_becomes_a_closed_mesh_that_looks_like_it(method, caplog):
    """The same each time, without NaN."""
    gaussians, options = painted_ball(), dataclasses.replace(SMALL, method=method)
    mesh = mesh_from_gaussians(gaussians, options)
    broken = clouds_together(gaussians, gaussians.rows(slice(5)))
    broken.means[-5:] = np.nan
    again = mesh_from_gaussians(broken, options)
    np.testing.assert_array_equal(mesh.vertices, again.vertices)
    np.testing.assert_array_equal(mesh.texture, again.texture)
    assert f"5 of {len(broken.means)} Gaussians hold NaN or infinity" in caplog.text
    assert closed(mesh) and len(mesh.faces) <= 600 and mesh.texture.shape == (128, 128, 3)
    radius = np.linalg.norm(mesh.vertices, axis=1)
    assert 0.75 < radius.min() and radius.max() < 0.95
    assert psnr_to_cloud(mesh, gaussians) > 24


def clouds_together(*clouds):
    return Gaussians(*(np.concatenate(values) for values in zip(*clouds, strict=True)))


def moved(cloud, offset):
    return cloud._replace(means=cloud.means + np.float32(offset))


def parts(mesh):
    """Return the areas of the connected parts, relative to the whole, largest first."""
    pieces = trimesh.Trimesh(mesh.vertices, mesh.faces).split(only_watertight=False)
    areas = sorted((piece.area for piece in pieces), reverse=True)
    return np.array(areas) / sum(areas)


def test_a_speck_is_dropped_and_a_hat_stays(caplog):
    ball, hat = painted_ball(300), moved(painted_ball(60, radius=0.13), [0, 0, 1.15])
    speck = moved(painted_ball(30, radius=0.03), [1.2, 0, 0])
    options = dataclasses.replace(SMALL, resolution=48)
    mesh = mesh_from_gaussians(clouds_together(ball, hat, speck), options)
    assert len(parts(mesh)) == 2 and parts(mesh)[1] < 0.04
    assert mesh.vertices[:, 0].max() < 1 < mesh.vertices[:, 2].max()
    assert caplog.text.count("loose parts below 1.00% of the area are left out") == 1


def test_tips_that_simplification_cuts_off_are_dropped(caplog):
    """Thin spikes break where fewer faces are left, and their tips float."""
    ball, directions = painted_ball(300), sphere_points(20)
    means = directions[:, None] * np.linspace(0.8, 1.3, 24)[:, None]
    spikes = painted_ball(20 * 24)._replace(means=means.reshape(-1, 3).astype(np.float32))
    spikes = spikes._replace(log_scales=np.full((20 * 24, 3), np.log(0.035), np.float32))
    options = dataclasses.replace(SMALL, faces=200, resolution=48)
    mesh = mesh_from_gaussians(clouds_together(ball, spikes), options)
    assert len(parts(mesh)) == 1 and closed(mesh)
    assert "loose parts below" in caplog.text


def test_a_cloud_without_visible_gaussians_and_a_missing_library_are_refused(monkeypatch):
    with pytest.raises(UserError, match="no view is covered to more than half"):  # fog
        mesh_from_gaussians(painted_ball(30, opacity=0.05), SMALL)
    monkeypatch.setattr(textured, "render", None)
    for gaussians in (painted_ball(300).rows(slice(0)), painted_ball(300, opacity=0.01)):
        refused("form no surface", mesh_from_gaussians, gaussians, SMALL)
    monkeypatch.setattr(textured, "finite", None)
    for library in ("xatlas", "fast_simplification", "skimage"):  # the first of many is named
        monkeypatch.setitem(sys.modules, library, None)
        said = rf"needs {library} .*threestudio-gaussiandreamer\[mesh\]"
        refused(said, mesh_from_gaussians, painted_ball(20))


def test_a_part_as_thin_as_a_cell_stays(caplog):
    """A plate on a rod, as a mirror of a truck."""
    rng, cell = np.random.default_rng(0), 1.8 / 48
    ball, height = 0.5 * sphere_points(1500), np.arange(0.45, 1.1, cell / 4)
    rod = np.stack([0 * height, 0 * height, height], axis=1)
    plate = (rng.random((800, 3)) - 0.5) * [0.3, 0.3, 2 * cell] + [0, 0, 1.15]
    means = np.concatenate([ball, rod, plate]).astype(np.float32)
    sizes = np.repeat([0.03, cell / 3, cell / 2], [len(ball), len(rod), len(plate)])
    scales = np.log(np.repeat(sizes[:, None], 3, 1)).astype(np.float32)
    cloud = painted_ball(len(means), opacity=0.99)._replace(means=means, log_scales=scales)
    options = dataclasses.replace(SMALL, faces=2000, resolution=48, view_size=192)
    mesh = mesh_from_gaussians(cloud, options)
    assert mesh.vertices[:, 2].max() > 1.1 and len(parts(mesh)) == 1
    assert "loose parts" not in caplog.text


@pytest.mark.parametrize(
    "options, message",
    [
        ({"faces": 10**6}, "--faces: expected a number from 100 to 100000"),
        ({"faces": 50_000, "texture": 512}, "--faces: a texture of 512 x 512 texels has room for"),
        ({"texture": 0}, "--texture: expected a number from 64 to 8192"),
        ({"views": 1}, "--views: expected a number from 8"),
        ({"method": "fuson"}, "did you mean 'fusion'"),
        ({"eps2d": -1}, "--eps2d: expected 0 or more"),
    ],
)
def test_wrong_options_are_refused_before_any_work(options, message, monkeypatch):
    monkeypatch.setattr(textured, "finite", None)
    refused(message, mesh_from_gaussians, painted_ball(20), MeshOptions(**options), "--")
