"""SMPL's pose and shape from the positions of its joints, with smplx's kinematics.

The body model is the user's own file of SMPL, SMPL-H or SMPL-X, whose first 22 joints are the same.
What is minimised, over the rotations of all joints (axis-angle), a translation and a few shape
coefficients, summed over the frames, which share nothing:

    sum_j |joint_j - target_j|^2 / s^2 + pose |theta|^2 + shape |beta|^2
        + limits sum max(0, low - theta, theta - high)^2,   s = 10 mm

The limits keep knees and elbows from bending backwards, which positions alone would allow. First
the whole body is placed, then the pose is fitted under a strong prior, then under the final one."""

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..core.devices import torch_threads
from ..core.extras import require_extra
from ..formats.array_files import read_arrays
from ..formats.reading import reading, require
from .body_pose import BODY_JOINTS

FIELDS = ("v_template", "shapedirs", "posedirs", "J_regressor", "weights", "kintree_table", "f")
"""Arrays of a body model's file that are used."""
SMPL_JOINTS, SHAPES = 24, 10
"""Joints of SMPL, and the shape coefficients that are used."""
TRUNK = (0, 1, 2, 3, 6, 9, 13, 14, 16, 17)
"""Pelvis, hips, spine, collars and shoulders, which move almost as one."""
SCALE = 0.01
"""Metres on a joint that weigh as one unit of the priors."""
SHAPE_WEIGHT = 0.01
LIMITS_WEIGHT = 1000.0
STAGES = ((1.0, 0.2), (0.02, 1.0))
"""Weight of the pose prior, and the share of the iterations, of each stage."""
DEGREES = math.pi / 180
KNEE = {0: (0, 150), 1: (-15, 15), 2: (-15, 15)}
ANKLE = {0: (-60, 60), 1: (-45, 45), 2: (-45, 45)}
LIMITS = {
    **{4: KNEE, 5: KNEE, 18: {1: (-150, 5)}, 19: {1: (-5, 150)}},  # elbows bend about y
    **{joint: dict.fromkeys(range(3), (-60, 60)) for joint in (3, 6, 9, 12, 15)},  # spine, head
    **{7: ANKLE, 8: ANKLE},
}
"""Joint: axis: (low, high), degrees."""


class BodyModel(NamedTuple):
    """A skinned body, float64 tensors in the layout of smplx's functions."""

    template: Float[Tensor, "V 3"]
    """Metres, y up, looking along +z."""
    shape_directions: Float[Tensor, "V 3 B"]
    pose_directions: Float[Tensor, "P V3"]
    joint_regressor: Float[Tensor, "J V"]
    parents: Int[Tensor, " J"]
    weights: Float[Tensor, "V J"]
    faces: Int[np.ndarray, "F 3"]


class BodyFit(NamedTuple):
    """The bodies that were fitted to F frames."""

    pose: Float[Tensor, "F J 3"]
    """Axis-angle rotation of each joint, the whole body's first; radians."""
    shape: Float[Tensor, "F B"]
    translation: Float[Tensor, "F 3"]
    residuals: Float[np.ndarray, "F K"]
    """Distance of each fitted joint from where it should be, millimetres."""


def load_body_model(path: str) -> BodyModel:
    """Read the user's body model, an NPZ or SMPL's own PKL, of which no code is run.

    Raises:
        UserError: missing, or not a body model; the message says what to do.
    """
    kind = "body model (the NPZ or PKL of SMPL, SMPL-H or SMPL-X)"
    with reading(path, kind) as file:
        arrays = read_arrays(file, kind, FIELDS)
        _check(arrays)
    vertices, joints = len(arrays["v_template"]), len(arrays["J_regressor"])
    parents = torch.from_numpy(arrays["kintree_table"][0].astype(np.int64))
    parents[0] = -1
    directions = _tensor(arrays["posedirs"]).reshape(vertices * 3, 9 * (joints - 1))
    return BodyModel(
        template=_tensor(arrays["v_template"]),
        shape_directions=_tensor(arrays["shapedirs"][:, :, :SHAPES]),
        pose_directions=directions.T.contiguous(),
        joint_regressor=_tensor(arrays["J_regressor"]),
        parents=parents,
        weights=_tensor(arrays["weights"]),
        faces=arrays["f"].astype(np.int64),
    )


def fit_bodies(
    model: BodyModel, targets: Float[np.ndarray, "F K 3"], *, iterations: int = 300
) -> BodyFit:
    """Return bodies whose joints are where ``targets`` has them.

    Args:
        targets: 22 or 24 joints in SMPL's order, metres, y up; the last two of 24 are used when the
            model has no more.
        iterations: the most of the last stage.
    """
    require_extra("smpl", "smplx")
    joints = len(model.parents)
    wanted = _tensor(targets)[:, : SMPL_JOINTS if joints == SMPL_JOINTS else BODY_JOINTS]
    frames = len(wanted)
    pose = torch.zeros(frames, joints, 3, dtype=torch.float64)
    pose[:, 0], translation = _placed(model, wanted)
    shape = torch.zeros(frames, model.shape_directions.shape[-1], dtype=torch.float64)
    body = pose, shape, translation
    with torch_threads(1):
        for weight, share in STAGES:
            _minimise(body, partial(energy, model, body, wanted, weight), int(share * iterations))
    found = posed_joints(model, *body)[:, : wanted.shape[1]]
    return BodyFit(*body, (1000 * (found - wanted).norm(dim=-1)).numpy())


def energy(
    model: BodyModel, body: tuple[Tensor, Tensor, Tensor], wanted: Tensor, weight: float
) -> Tensor:
    """Compute the objective of the fit, with this weight of the pose prior, summed over the frames.
    ``body`` is pose, shape and translation.
    """
    pose, shape, _ = body
    found = posed_joints(model, *body)[:, : wanted.shape[1]]
    data = ((found - wanted) / SCALE).square().sum()
    priors = weight * pose[:, 1:].square().sum() + SHAPE_WEIGHT * shape.square().sum()
    return data + priors + LIMITS_WEIGHT * beyond_limits(pose)


def beyond_limits(pose: Float[Tensor, "F J 3"]) -> Tensor:
    """Return the sum of squares of the angles, in radians, by which rotations exceed ``LIMITS``."""
    rows = [(j, axis, *ends) for j, axes in LIMITS.items() for axis, ends in axes.items()]
    joints, axes, low, high = torch.tensor(rows, dtype=pose.dtype).T
    angles = pose[:, joints.long(), axes.long()]
    under, over = low * DEGREES - angles, angles - high * DEGREES
    return under.clamp_min(0).square().sum() + over.clamp_min(0).square().sum()


def posed_joints(
    model: BodyModel,
    pose: Float[Tensor, "F J 3"],
    shape: Float[Tensor, "F B"],
    translation: Float[Tensor, "F 3"],
) -> Float[Tensor, "F J 3"]:
    """Return the joint positions, which is cheaper than the whole body."""
    from smplx.lbs import batch_rigid_transform, batch_rodrigues

    frames, joints = pose.shape[:2]
    directions = torch.einsum("jv,vcb->jcb", model.joint_regressor, model.shape_directions)
    rest = model.joint_regressor @ model.template + torch.einsum("fb,jcb->fjc", shape, directions)
    rotations = batch_rodrigues(pose.reshape(-1, 3)).reshape(frames, joints, 3, 3)
    found, _ = batch_rigid_transform(rotations, rest, model.parents, dtype=pose.dtype)
    return found + translation[:, None]


@torch.no_grad()
def posed_vertices(model: BodyModel, fit: BodyFit) -> Float[np.ndarray, "F V 3"]:
    """Return the surfaces of the fitted bodies: metres, y up."""
    from smplx.lbs import lbs

    vertices, _ = lbs(fit.shape, fit.pose.flatten(1), *model[:-1])  # in the order of lbs
    return (vertices + fit.translation[:, None]).numpy()


def _placed(
    model: BodyModel, wanted: Float[Tensor, "F K 3"]
) -> tuple[Float[Tensor, "F 3"], Float[Tensor, "F 3"]]:
    """Return the rotation (axis-angle) and translation that bring the resting trunk nearest to the
    wanted one (Kabsch 1976).
    """
    from scipy.spatial.transform import Rotation

    rest = (model.joint_regressor @ model.template)[list(TRUNK)]
    there = wanted[:, list(TRUNK)]
    moved = there - there.mean(1, keepdim=True)
    covariance = torch.einsum("fkc,kd->fcd", moved, rest - rest.mean(0))
    u, _, vt = torch.linalg.svd(covariance)
    signs = torch.ones(len(wanted), 3, dtype=wanted.dtype)
    signs[:, 2] = torch.linalg.det(u @ vt).sign()
    rotation = u @ (signs[:, :, None] * vt)
    root = (model.joint_regressor @ model.template)[0]  # the body turns about its first joint
    translation = there.mean(1) - torch.einsum("fcd,d->fc", rotation, rest.mean(0) - root) - root
    return _tensor(Rotation.from_matrix(rotation.numpy()).as_rotvec()), translation


def _minimise(body: tuple[Tensor, ...], loss: Callable[[], Tensor], iterations: int) -> None:
    """Minimise ``loss`` over the tensors of ``body`` with L-BFGS, in place."""
    for tensor in body:
        tensor.requires_grad_(True)
    options = {"history_size": 20, "line_search_fn": "strong_wolfe", "tolerance_change": 1e-5}
    # the order of the parameters is that of the sums in the line search
    optimiser = torch.optim.LBFGS([body[0], body[2], body[1]], max_iter=iterations, **options)

    def closure() -> Tensor:
        optimiser.zero_grad()
        value = loss()
        value.backward()
        return value

    optimiser.step(closure)
    for tensor in body:
        tensor.requires_grad_(False)


def _check(arrays: dict[str, np.ndarray]) -> None:
    """Raise Unreadable unless the arrays are those of a body with SMPL's 22 joints or more."""
    vertices, joints = len(arrays["v_template"]), len(arrays["J_regressor"])
    expected = {
        "v_template": (vertices, 3),
        "shapedirs": (vertices, 3, *arrays["shapedirs"].shape[2:3]),
        "posedirs": (vertices, 3, 9 * (joints - 1)),
        "J_regressor": (joints, vertices),
        "weights": (vertices, joints),
        "kintree_table": (2, joints),
        "f": (len(arrays["f"]), 3),
    }
    parents, faces = arrays["kintree_table"].astype(np.int64), arrays["f"].astype(np.int64)
    shapes = ", ".join(f"{name} {arrays[name].shape}" for name in FIELDS)
    require(
        joints >= BODY_JOINTS
        and all(arrays[name].shape == shape for name, shape in expected.items())
        and all(np.isfinite(values).all() for values in arrays.values())
        and ((parents[0, 1:] >= 0) & (parents[0, 1:] < np.arange(1, joints))).all()
        and ((faces >= 0) & (faces < vertices)).all(),
        f"it is damaged, or has other arrays ({shapes}): finite numbers that fit each other, of "
        f"{BODY_JOINTS} joints or more, were expected; get it again",
    )


def _tensor(values: np.ndarray) -> Tensor:
    return torch.from_numpy(np.ascontiguousarray(values, dtype=np.float64))
