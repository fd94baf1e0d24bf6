"""Gaussians in other axes look the same from a camera that is rotated with them."""

import numpy as np
import pytest
import torch

from tests.helpers.ply_files import gaussians
from tests.helpers.refusals import refused
from threestudio_gaussiandreamer.gaussians.axes import AXES, FRONTS, rotate, rotation_between
from threestudio_gaussiandreamer.gaussians.gaussians import opaque, usable
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.splatting import rasterize


def some(degree, count=60):
    values = gaussians(count, degree).map(lambda value: np.float32(0.5) * value)
    return values._replace(log_scales=values.log_scales - 2)


def picture(cloud, rotation=AXES["y"]):
    means, quats, log_scales, logits, sh = cloud.tensors()
    view = torch.eye(4)
    view[:3, :3], view[2, 3] = torch.from_numpy(rotation.T).float(), 4.0
    position = torch.from_numpy(rotation).float() @ torch.tensor([0, 0, -4.0])
    Ks = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    colors, shape = sh_to_colors(sh, means - position), (means, quats, log_scales.exp())
    return rasterize(*shape, logits.sigmoid(), colors, view[None], Ks[None], 32, 32).image


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("up", AXES)
def test_rotated_gaussians_look_the_same_from_a_rotated_camera(up, degree):
    cloud = some(degree)
    assert np.linalg.det(AXES[up]) == pytest.approx(1)
    difference = picture(rotate(cloud, AXES[up]), AXES[up]) - picture(cloud)
    assert difference.abs().max() < 1e-3  # alpha is cut off at 1/1024


def test_front_and_top_of_the_world_in_each_file():
    """In -y-up files the front is along -z: a camera (x right, y down) there looks along +z."""
    front, left, up = np.eye(3)
    for axis, expected in {
        "y": ([0, 0, 1], [1, 0, 0], [0, 1, 0]),
        "-y": ([0, 0, -1], [1, 0, 0], [0, -1, 0]),
        "z": (front, left, up),
    }.items():
        rotation = rotation_between("z", axis)
        for ours, theirs in zip((front, left, up), expected, strict=True):
            np.testing.assert_array_equal(rotation @ ours, theirs)
        named = "xyz".index(FRONTS[axis][1])
        assert (rotation @ front)[named] == (-1 if FRONTS[axis][0] == "-" else 1)
    refused("degree 4 can't be converted to other axes: degree 3", rotate, some(4), AXES["z"])


def test_usable_lets_infinite_logarithms_pass_where_they_mean_zero_or_one():
    cloud = some(1, 8)
    cloud.means[0, 0] = np.nan
    cloud.quats[1, 0] = np.inf
    cloud.sh[2, 1, 0] = -np.inf
    cloud.logit_opacities[3:6] = [np.nan, np.inf, -np.inf]
    cloud.log_scales[6:, 0] = [np.inf, -np.inf]
    assert usable(cloud).tolist() == [False] * 4 + [True, True, False, True]
    cloud = some(1, 4)._replace(logit_opacities=np.float32([np.nan, -np.inf, 0, 1]))
    assert opaque(cloud, 0).tolist() == [False, True, True, True]
    assert opaque(cloud, 0.5).tolist() == [False, False, True, True]
