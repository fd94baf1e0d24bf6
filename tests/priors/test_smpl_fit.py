"""SMPL from joints: the user's body file, and the recovery of known poses."""

import pickle
import sys
import types

import numpy as np
import pytest
import scipy.sparse
import torch

from tests.helpers import tiny_3d_models as tiny
from tests.priors.cases import joints_of
from threestudio_gaussiandreamer.core.errors import UserError
from threestudio_gaussiandreamer.priors import motion
from threestudio_gaussiandreamer.priors.motion import (
    beyond_limits,
    energy,
    fit_bodies,
    load_body_model,
    posed_vertices,
)


def random_poses(count, seed=0, spread=0.25):
    """Return poses within the limits: rotations of about ``spread`` radians, those with limits
    uniformly between them.
    """
    rng = torch.Generator().manual_seed(seed)
    pose = spread * torch.randn(count, 24, 3, generator=rng, dtype=torch.float64)
    for joint, axes in motion.LIMITS.items():
        for axis, (low, high) in axes.items():
            part = 0.15 + 0.7 * torch.rand(count, generator=rng, dtype=torch.float64)
            pose[:, joint, axis] = (low + (high - low) * part) * motion.DEGREES
    pose[:, 0] = torch.randn(count, 3, generator=rng, dtype=torch.float64)
    return pose


@pytest.mark.parametrize("protocol", [0, 2, pickle.HIGHEST_PROTOCOL])
def test_the_pkl_is_read_without_chumpy(tmp_path, body_file, monkeypatch, protocol):
    """SMPL's file has arrays of chumpy and a sparse matrix, MANO's a selection of chumpy's too."""
    arrays, ch = tiny.body_arrays(), types.ModuleType("chumpy.ch")
    for name in ("Ch", "Select"):
        init = {"__init__": lambda self, **state: vars(self).update(state)}
        made = {"__module__": "chumpy.ch", **init}
        setattr(ch, name, type(name, (), made))
    shapes = arrays["shapedirs"]
    arrays["J_regressor"] = scipy.sparse.csc_matrix(arrays["J_regressor"])
    arrays["v_template"] = ch.Ch(x=arrays["v_template"])
    arrays["shapedirs"] = ch.Select(
        a=ch.Ch(x=np.asfortranarray(shapes[::-1])),
        idxs=np.arange(shapes.size).reshape(shapes.shape)[::-1].ravel(),
        preferred_shape=shapes.shape,
    )
    with monkeypatch.context() as context:
        context.setitem(sys.modules, "chumpy", types.ModuleType("chumpy"))
        context.setitem(sys.modules, "chumpy.ch", ch)
        (tmp_path / "SMPL_NEUTRAL.pkl").write_bytes(pickle.dumps(arrays, protocol))
    paths = (tmp_path / "SMPL_NEUTRAL.pkl", body_file)
    read, original = (load_body_model(str(path)) for path in paths)
    for a, b in zip(read, original, strict=True):
        np.testing.assert_array_equal(a, b)


def test_bodies_with_hands_are_read(tmp_path, body):
    """SMPL-H and SMPL-X have other joints after the 22nd, and are distributed as NPZ."""
    arrays, more = tiny.body_arrays(), 28
    vertices = len(arrays["v_template"])
    arrays["posedirs"] = np.zeros((vertices, 3, 9 * 51))
    regressor, tree = arrays["J_regressor"], np.array([[20] * more, range(24, 52)], np.uint32)
    arrays["J_regressor"] = np.concatenate([regressor, np.repeat(regressor[20:21], more, axis=0)])
    arrays["weights"] = np.concatenate([arrays["weights"], np.zeros((vertices, more))], axis=1)
    arrays["kintree_table"] = np.concatenate([arrays["kintree_table"], tree], axis=1)
    np.savez(tmp_path / "SMPLH_NEUTRAL.npz", **arrays)
    model = load_body_model(str(tmp_path / "SMPLH_NEUTRAL.npz"))
    targets = joints_of(body, random_poses(1))
    fit = fit_bodies(model, targets, iterations=100)
    # joints 22 and 23 of SMPL are other ones here
    assert fit.residuals.shape == (1, 22) and fit.residuals.mean() < 10
    assert posed_vertices(model, fit).shape == (1, vertices, 3)


@pytest.mark.parametrize(
    "change, message",
    [
        (lambda arrays: arrays.pop("posedirs"), "no array 'posedirs'"),
        (lambda arrays: arrays.update(weights=arrays["weights"][:, :20]), "arrays.*fit each other"),
        (lambda arrays: arrays["v_template"].__setitem__(0, np.nan), "damaged"),
        (lambda arrays: arrays["kintree_table"].__setitem__((0, 5), 5), "damaged"),
        (lambda arrays: arrays["f"].__setitem__((0, 0), 10**6), "damaged"),
    ],
)
def test_other_body_files_are_refused(tmp_path, change, message):
    arrays = tiny.body_arrays()
    change(arrays)
    np.savez(tmp_path / "body.npz", **arrays)
    with pytest.raises(UserError, match=message):
        load_body_model(str(tmp_path / "body.npz"))


def test_known_poses_and_surfaces_are_found(body):
    """The twist of the bones follows from the prior, and hardly moves the surface of thin tubes."""
    pose = random_poses(4)
    shape = torch.zeros(4, 10, dtype=torch.float64)
    shape[:, 0] = torch.linspace(-1, 1, 4)
    translation = torch.linspace(-2, 2, 12, dtype=torch.float64).reshape(4, 3)
    fit = fit_bodies(body, joints_of(body, pose, shape, translation)[:, :22])
    assert fit.residuals.shape == (4, 22)
    assert fit.residuals.mean() < 2 and fit.residuals.max() < 8  # mm; the pose prior pulls a little
    assert beyond_limits(fit.pose) < 1e-3  # square radians
    # wrists, head and toes have no joints after them, and keep the rest pose
    assert fit.pose[:, [10, 11, 15, 20, 21, 22, 23]].abs().max() < 1e-3
    pose = random_poses(2, seed=1, spread=0.1)
    fit = fit_bodies(body, joints_of(body, pose))
    zeros = torch.zeros(2, 10, dtype=torch.float64), torch.zeros(2, 3, dtype=torch.float64)
    truth = posed_vertices(body, motion.BodyFit(pose, *zeros, fit.residuals))
    apart = np.linalg.norm(posed_vertices(body, fit) - truth, axis=-1)
    assert apart.mean() < 0.02  # metres; tubes are 8 cm thick
    assert fit.residuals.shape == (2, 24) and fit.residuals.mean() < 2


def test_smplx_agrees_that_posed_joints_are_those_of_the_body(body):
    from smplx.lbs import lbs

    pose, shape = random_poses(2), torch.full((2, 10), 0.5, dtype=torch.float64)
    _, joints = lbs(shape, pose.flatten(1), *body[:-1])
    np.testing.assert_allclose(joints_of(body, pose, shape), joints.numpy(), atol=1e-12)


def test_knees_bend_forwards(body):
    """A leg that is bent backwards is not fitted."""
    pose = torch.zeros(2, 24, 3, dtype=torch.float64)
    assert beyond_limits(pose) == 0
    pose[0, 4, 0], pose[1, 4, 0] = 1.2, -1.2
    fit = fit_bodies(body, joints_of(body, pose), iterations=100)
    assert fit.pose[0, 4, 0] > 1.1 and fit.residuals[0].mean() < 2
    assert fit.pose[1, 4, 0] > -0.1 and fit.residuals[1].mean() > 5
    pose[:, 4, 0] = torch.tensor([-0.5, 0.0])  # a knee the wrong way
    pose[0, 18, 1] = -1.0  # an elbow the right way
    assert beyond_limits(pose).item() == pytest.approx(0.25)


def test_energys_gradient(body):
    """An energy of 1e5 is rounded by 1e-11, so differences of 1e-6 have errors of 1e-5 and more."""
    wanted = torch.from_numpy(joints_of(body, random_poses(1)))
    values = [0.3 * torch.randn(1, *s, dtype=torch.float64) for s in ((24, 3), (10,), (3,))]
    inputs = [value.requires_grad_() for value in values]
    closeness = {"eps": 1e-6, "rtol": 1e-4, "atol": 0.1}
    assert torch.autograd.gradcheck(lambda *v: energy(body, v, wanted, 0.1), inputs, **closeness)
