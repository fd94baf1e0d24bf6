"""The rotation matrix of a quaternion: against scipy, equal for arrays and tensors."""

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from threestudio_gaussiandreamer.core.quaternions import rotation_rows


def test_the_rows_are_those_of_scipy_for_arrays_and_tensors():
    quats = np.random.default_rng(0).normal(size=(20, 4))
    quats /= np.linalg.norm(quats, axis=1, keepdims=True)
    rows = np.moveaxis(np.array(rotation_rows(*quats.T)), -1, 0)
    expected = Rotation.from_quat(quats[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(rows, expected, atol=1e-14)
    tensors = rotation_rows(*torch.from_numpy(quats).unbind(1))
    assert all(
        torch.equal(entry, torch.from_numpy(rows[:, i, j]))
        for i, row in enumerate(tensors)
        for j, entry in enumerate(row)
    )
