"""The axes of other programs: an object's top and front get to where ours are."""

import numpy as np
import pytest

from tests.helpers.object_clouds import ball
from threestudio_gaussiandreamer.convert.producers import (
    PRODUCERS,
    VECTORS,
    from_producer,
    to_y_up,
)
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.formats.gaussian_files import StoredCloud
from threestudio_gaussiandreamer.gaussians.axes import AXES


@pytest.mark.parametrize("name", PRODUCERS)
def test_up_and_front_of_a_producer_become_ours(name):
    producer = PRODUCERS[name]
    rotation = to_y_up(producer)
    np.testing.assert_allclose(np.linalg.det(rotation), 1)
    cloud = ball(2)
    cloud.means[:] = [VECTORS[producer.up], 2 * VECTORS[producer.front]]
    world = from_producer(StoredCloud(cloud), name).in_axes("z").gaussians
    np.testing.assert_allclose(world.means, [[0, 0, 1], [2, 0, 0]], atol=1e-6)


@pytest.mark.parametrize(("name", "up"), [("3dgs", "-y"), ("lgm", "y"), ("nerfstudio", "z")])
def test_plain_axes_agree_with_the_option_up(name, up):
    np.testing.assert_allclose(to_y_up(PRODUCERS[name]), AXES[up], atol=1e-12)


def test_trellis_saves_its_z_up_objects_with_y_down():
    """Its transform (x, -z, y) of an object with z up and the front to -y."""
    saved = np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]]) @ np.array([[0, 0], [0, -1], [1, 0]])
    producer = PRODUCERS["trellis"]
    np.testing.assert_array_equal(saved.T, [VECTORS[producer.up], VECTORS[producer.front]])


def test_triposplats_viewer_shows_its_front():
    """splat.rotation.y = pi / 2, then root.rotation.x = pi; the camera is on +z, y is up."""
    about_y = np.array([[0, 0, 1], [0, 1, 0], [-1, 0, 0]])
    seen = np.diag([1, -1, -1]) @ about_y
    producer = PRODUCERS["triposplat"]
    np.testing.assert_array_equal(seen @ VECTORS[producer.up], [0, 1, 0])
    np.testing.assert_array_equal(seen @ VECTORS[producer.front], [0, 0, 1])


def test_an_unknown_producer_is_refused_with_the_nearest():
    with pytest.raises(UserError, match="unknown producer 'triposplt': did you mean 'triposplat'"):
        from_producer(StoredCloud(ball(1)), "triposplt")
