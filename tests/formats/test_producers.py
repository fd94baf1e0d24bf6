"""The axes of other programs: an object's top and front get to where ours are.

``EXPORTS`` repeats what each program's published source does (docs/formats.md names the files)."""

import numpy as np
import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats import producers
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from threestudio_gaussiandreamer.gaussians.axes import AXES


def about(axis, degrees):
    """Return the rotation by ``degrees`` about the axis x, y or z."""
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
    rotation = np.eye(3)
    rotation[[i, i, j, j], [i, j, i, j]] = cos, -sin, sin, cos
    return rotation.round(12)


Z_UP_FRONT_MINUS_Y = ((0, 0, 1), (0, -1, 0))
"""Blender's axes of an imported glTF file: up and front."""
Z_UP_FRONT_X = ((0, 0, 1), (1, 0, 0))
OPENGL = ((0, 1, 0), (0, 0, 1))
SAVE_PLY = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
TO_GLB = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]).T
RENDERER = np.array([[-1, 0, 0], [0, 0, 1], [0, -1, 0]])
"""Hunyuan3D's texture stage loads (x, y, z) as (-x, z, -y), mirrored, and mirrors its pictures."""
EXPORTS = [
    ("trellis", producers.GAUSSIANS, Z_UP_FRONT_MINUS_Y, SAVE_PLY),
    ("trellis", producers.MESH, Z_UP_FRONT_MINUS_Y, TO_GLB),
    ("trellis2", producers.MESH, Z_UP_FRONT_MINUS_Y, np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])),
    ("sam3d", producers.GAUSSIANS, Z_UP_FRONT_MINUS_Y, np.eye(3)),
    ("sam3d", producers.MESH, Z_UP_FRONT_MINUS_Y, TO_GLB),
    ("lgm", producers.GAUSSIANS, OPENGL, np.eye(3)),
    ("lgm", producers.MESH, OPENGL, np.eye(3)),
    ("diffsplat", producers.GAUSSIANS, OPENGL, np.eye(3)),
    ("triposr", producers.MESH, Z_UP_FRONT_X, np.eye(3)),
    ("triposr-app", producers.MESH, Z_UP_FRONT_X, about("y", 90) @ about("x", -90)),
    ("triposg", producers.MESH, OPENGL, np.eye(3)),
    # its cameras: elevation 90 at (0, 0, -1), azimuth 0 at (0, 1, 0) of the renderer
    ("hunyuan3d", producers.MESH, ((0, 0, -1), (0, 1, 0)), np.linalg.inv(RENDERER)),
    # its viewer: y up, the camera on +z, the file turned about y and then about x
    ("triposplat", producers.GAUSSIANS, OPENGL, np.linalg.inv(about("x", 180) @ about("y", 90))),
]


@pytest.mark.parametrize(("name", "kind", "axes", "export"), EXPORTS)
def test_a_producers_export_puts_up_and_front_where_the_table_says(name, kind, axes, export):
    found = producers.producer_axes(name, kind)
    np.testing.assert_allclose(export @ axes[0], producers.VECTORS[found.up], atol=1e-9)
    np.testing.assert_allclose(export @ axes[1], producers.VECTORS[found.front], atol=1e-9)


def test_every_generator_is_among_the_exports_and_others_have_axes_or_are_refused():
    others = {"3dgs", "nerfstudio", "supersplat"}  # conventions of programs that generate nothing
    kinds = {(name, kind) for name, kind, *_ in EXPORTS}
    assert kinds == {
        (name, kind)
        for name, known in producers.PRODUCERS.items()
        for kind in (producers.GAUSSIANS, producers.MESH)
        if name not in others and getattr(known, kind)
    }
    with pytest.raises(UserError, match="unknown producer 'triposplt': did you mean 'triposplat'"):
        producers.from_producer(StoredCloud(ball(1)), "triposplt")
    with pytest.raises(UserError, match="'triposr' stands for files of meshes.* are 3dgs, "):
        producers.from_producer(StoredCloud(ball(1)), "triposr")
    with pytest.raises(UserError, match="'diffsplat' stands for files of Gaussians.*hunyuan3d"):
        producers.producer_axes("diffsplat", producers.MESH)
    raw = StoredCloud(ball(9), "y")
    found = producers.from_producer(raw, "supersplat", ".spz").gaussians.means
    np.testing.assert_allclose(found, raw.gaussians.means * [1, -1, -1], atol=1e-6)
    for name, up in (("3dgs", "-y"), ("lgm", "y"), ("nerfstudio", "z")):
        axes = producers.producer_axes(name, producers.GAUSSIANS)
        np.testing.assert_allclose(producers.to_y_up(axes), AXES[up], atol=1e-12)


@pytest.mark.parametrize("name", producers.producers_of(producers.GAUSSIANS))
def test_up_and_front_of_a_producer_become_ours(name):
    axes = producers.producer_axes(name, producers.GAUSSIANS)
    rotation = producers.to_y_up(axes)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    cloud = ball(2)
    cloud.means[:] = [producers.VECTORS[axes.up], 2 * producers.VECTORS[axes.front]]
    world = producers.from_producer(StoredCloud(cloud), name).in_axes("z").gaussians
    np.testing.assert_allclose(world.means, [[0, 0, 1], [2, 0, 0]], atol=1e-6)


@pytest.mark.parametrize(
    ("name", "suffix"), [("3dgs", ".spz"), ("supersplat", ".glb"), ("lgm", ".glb")]
)
def test_formats_with_axes_of_their_own_come_from_a_turned_ply(tmp_path, name, suffix):
    source = StoredCloud(ball(300), "-y")
    write_cloud(str(tmp_path / ("a" + suffix)), source)
    found = producers.from_producer(read_cloud(str(tmp_path / ("a" + suffix))), name, suffix)
    expected = producers.from_producer(source, name).gaussians.means
    nearest = np.linalg.norm(found.gaussians.means[:, None] - expected, axis=2).min(axis=1)
    assert nearest.max() < 1e-3
