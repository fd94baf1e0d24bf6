"""Gaussians in other axes look the same from a camera that is rotated with them."""

import numpy as np
import pytest
import torch

from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.gaussians.axes import AXES, FRONTS, rotate, rotation_between
from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians, opaque, usable
from threestudio_gaussiandreamer.gaussians.sh import sh_to_colors
from threestudio_gaussiandreamer.splatting import rasterize


def some(degree, count=60):
    rng = np.random.default_rng(0)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    gaussians = Gaussians(
        *(rng.normal(size=(count, *shape)).astype(np.float32) * 0.5 for shape in shapes)
    )
    return gaussians._replace(log_scales=gaussians.log_scales - 2)


def picture(gaussians, rotation=AXES["y"]):
    """Render from a camera that is rotated together with the Gaussians."""
    means, quats, log_scales, logits, sh = gaussians.tensors()
    view = torch.eye(4)
    view[:3, :3], view[2, 3] = torch.from_numpy(rotation.T).float(), 4.0
    position = torch.from_numpy(rotation).float() @ torch.tensor([0, 0, -4.0])
    Ks = torch.tensor([[30.0, 0, 16], [0, 30, 16], [0, 0, 1]])
    colors, shape = sh_to_colors(sh, means - position), (means, quats, log_scales.exp())
    return rasterize(*shape, logits.sigmoid(), colors, view[None], Ks[None], 32, 32).image


@pytest.mark.parametrize("degree", [0, 1, 2, 3])
@pytest.mark.parametrize("up", AXES)
def test_rotated_gaussians_look_the_same_from_a_rotated_camera(up, degree):
    gaussians = some(degree)
    assert np.linalg.det(AXES[up]) == pytest.approx(1)
    difference = picture(rotate(gaussians, AXES[up]), AXES[up]) - picture(gaussians)
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


def test_harmonics_that_have_no_rotation_here_are_refused():
    with pytest.raises(UserError, match="degree 4 can't be converted to other axes: degree 3"):
        rotate(some(4), AXES["z"])


def test_tensors_and_arrays_convert_back_and_forth_without_gradients():
    gaussians = some(1)
    tensors = gaussians.tensors().map(lambda values: values.requires_grad_())
    back = tensors.arrays()
    for ours, theirs in zip(back, gaussians, strict=True):
        assert ours.dtype == np.float32 and ours.tobytes() == theirs.tobytes()
    halves = gaussians.map(lambda values: torch.from_numpy(values).double())
    assert all(values.dtype == torch.float32 for values in halves.tensors())


def test_usable_lets_infinite_logarithms_pass_where_they_mean_zero_or_one():
    gaussians = some(1, 8)
    gaussians.means[0, 0] = np.nan
    gaussians.quats[1, 0] = np.inf
    gaussians.sh[2, 1, 0] = -np.inf
    gaussians.logit_opacities[3:6] = [np.nan, np.inf, -np.inf]
    gaussians.log_scales[6:, 0] = [np.inf, -np.inf]
    assert usable(gaussians).tolist() == [False] * 4 + [True, True, False, True]


def test_opaque_at_zero_keeps_every_number():
    gaussians = some(1, 4)._replace(logit_opacities=np.float32([np.nan, -np.inf, 0, 1]))
    assert opaque(gaussians, 0).tolist() == [False, True, True, True]
    assert opaque(gaussians, 0.5).tolist() == [False, False, True, True]
