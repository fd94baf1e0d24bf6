"""The turntable of a prior: its images, and the file."""

import numpy as np
import pytest
from PIL import Image

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud
from threestudio_gaussiandreamer.priors.cache import save_turntable, turntable


@pytest.fixture
def sphere():
    """Return 20,000 points around a distant centre: red on the +x side, blue on the +y side, else
    green.
    """
    rng = np.random.default_rng(0)
    points = rng.normal(size=(20_000, 3))
    points *= 40 / np.linalg.norm(points, axis=1, keepdims=True)
    x, y, _ = points.T
    colors = np.where(
        (x > np.abs(y))[:, None],
        [1.0, 0, 0],
        np.where((y > np.abs(x))[:, None], [0, 0, 1.0], [0, 1.0, 0]),
    )
    return PointCloud(points.astype(np.float32) + [100, -50, 7], colors.astype(np.float32))


def test_the_first_picture_is_the_front_and_it_turns_to_plus_y(sphere):
    pictures = turntable(sphere, views=4, size=64)
    assert pictures.shape == (4, 64, 64, 3) and pictures.dtype == np.uint8
    middle = pictures[:, 29:35, 29:35].mean(axis=(1, 2))
    np.testing.assert_allclose(
        middle[:3], [[255, 0, 0], [0, 0, 255], [0, 255, 0]], atol=25
    )  # a point's alpha is at most 0.95


def test_all_of_it_is_in_the_picture_on_white(sphere):
    pictures = turntable(sphere, views=3, size=64)
    border = np.concatenate(
        [pictures[:, 0], pictures[:, -1], pictures[:, :, 0], pictures[:, :, -1]], axis=1
    )
    assert (border == 255).all()
    covered = (pictures < 250).any(axis=-1).mean()
    assert 0.45 < covered < 0.6  # a disc of 1 / 1.3 of the height would be 0.46; its edges are soft


def test_one_point_is_a_picture():
    assert (turntable(PointCloud(np.zeros((1, 3)), np.zeros((1, 3))), views=1, size=32) < 128).any()


def test_the_file_is_an_endless_gif(sphere, tmp_path):
    save_turntable(sphere, tmp_path / "prior.gif", views=5, size=32)
    with Image.open(tmp_path / "prior.gif") as image:
        assert image.n_frames == 5 and image.size == (32, 32) and image.info["loop"] == 0
    with pytest.raises(UserError, match="cannot write"):
        save_turntable(sphere, tmp_path / "nowhere" / "prior.gif", views=1, size=32)
