"""The type that holds Gaussians: indexing, mapping and conversion apply to all its fields."""

import numpy as np
import torch

from threestudio_gaussiandreamer.gaussians.gaussians import Gaussians, opaque, usable


def some(count=5, degree=1):
    rng = np.random.default_rng(0)
    shapes = [(3,), (4,), (3,), (), ((degree + 1) ** 2, 3)]
    return Gaussians(*(rng.normal(size=(count, *shape)).astype(np.float32) for shape in shapes))


def test_tensors_and_arrays_convert_back_and_forth_without_gradients():
    gaussians = some()
    tensors = gaussians.tensors().map(lambda values: values.requires_grad_())
    back = tensors.arrays()
    for ours, theirs in zip(back, gaussians, strict=True):
        assert ours.dtype == np.float32 and ours.tobytes() == theirs.tobytes()
    halves = gaussians.map(lambda values: torch.from_numpy(values).double())
    assert all(values.dtype == torch.float32 for values in halves.tensors())


def test_usable_lets_infinite_logarithms_pass_where_they_mean_zero_or_one():
    gaussians = some(8)
    gaussians.means[0, 0] = np.nan
    gaussians.quats[1, 0] = np.inf
    gaussians.sh[2, 1, 0] = -np.inf
    gaussians.logit_opacities[3:6] = [np.nan, np.inf, -np.inf]
    gaussians.log_scales[6:, 0] = [np.inf, -np.inf]
    assert usable(gaussians).tolist() == [False] * 4 + [True, True, False, True]


def test_opaque_at_zero_keeps_every_number():
    gaussians = some(4)._replace(logit_opacities=np.float32([np.nan, -np.inf, 0, 1]))
    assert opaque(gaussians, 0).tolist() == [False, True, True, True]
    assert opaque(gaussians, 0.5).tolist() == [False, False, True, True]
