"""The data of a page: every float to the bit, or rounded where it is for comparison."""

import zlib

import numpy as np

from tests.view.clouds import cloud
from threestudio_gaussiandreamer.formats.ply import gaussian_columns
from threestudio_gaussiandreamer.view.page_data import COARSE_MEANS, coarse, packed


def unpacked(data: bytes, count: int) -> np.ndarray:
    """Return the columns (P, N), as the page's scripts do."""
    planes = np.frombuffer(zlib.decompress(data), np.uint8).reshape(-1, 4, count)
    return np.ascontiguousarray(planes.transpose(0, 2, 1)).view("<f4")[..., 0]


def test_packing_keeps_every_bit():
    gaussians = cloud(50, degree=2).gaussians
    columns = gaussian_columns(gaussians)
    found = unpacked(packed(gaussians), 50)
    assert np.array_equal(found[:3].T, columns[:, :3])
    assert np.array_equal(found[3:].T, columns[:, 6:])
    assert not columns[:, 3:6].any()  # the normals, which aren't stored


def test_a_coarse_cloud_is_a_fraction_of_the_size_and_hardly_moves():
    gaussians = cloud(4000, degree=1).gaussians
    rounded = coarse(gaussians)
    side = np.ptp(gaussians.means, axis=0).max()
    assert np.abs(rounded.means - gaussians.means).max() <= side / COARSE_MEANS
    assert rounded.sh.shape == (4000, 1, 3)
    assert len(packed(rounded)) < 0.4 * len(packed(gaussians._replace(sh=gaussians.sh[:, :1])))


def test_a_single_point_can_be_made_coarse():
    point = cloud(1).gaussians
    assert np.allclose(coarse(point).means, point.means)
