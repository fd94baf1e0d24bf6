"""Colours at positions on a mesh, and points on its surface."""

import numpy as np
import pytest

from threestudio_gaussiandreamer.meshes.load import load_mesh
from threestudio_gaussiandreamer.meshes.mesh import (
    Mesh,
    SurfaceDistance,
    surface_colors,
)

trimesh = pytest.importorskip("trimesh")
IMAGE = [[[255, 0, 0], [0, 255, 0]], [[0, 0, 255], [255, 255, 255]]]  # red green / blue white


def test_texels_are_bilinear_and_repeat():
    """Values at texel centres are the texels', halfway between two their mean; outside [0, 1] the
    texture repeats.
    """
    places = np.float32([[0.25, 0.75], [0.5, 0.75], [0.75, 0.25], [1.25, -0.25], [0.0, 0.75]])
    uv, faces = np.repeat(places, 3, axis=0), np.arange(15).reshape(5, 3)
    mesh = Mesh(np.zeros((15, 3)), faces, uv=uv, texture=np.array(IMAGE, np.uint8))
    expected = [[1, 0, 0], [0.5, 0.5, 0], [1, 1, 1], [1, 0, 0], [0.5, 0.5, 0]]
    found = surface_colors(mesh, np.arange(5), np.full((5, 3), 1 / 3))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_surface_distances_of_a_sphere(tmp_path):
    trimesh.creation.icosphere(4).export(tmp_path / "a.ply")
    mesh = load_mesh(tmp_path / "a.ply")
    points = np.array([[1.5, 0, 0], [0, 0, 0], [0, 1.0, 0]])
    # spacing of 2e5 samples on a sphere is 0.008; the icosphere's faces lie up to 0.002 inside
    np.testing.assert_allclose(SurfaceDistance(mesh)(points), [0.5, 1.0, 0.0], atol=0.012)
