"""Check the Gaussians of a checkpoint before they are used."""

from collections.abc import Mapping
from math import isqrt
from typing import Any

import torch
from torch import Tensor

from ..core.errors import UserError

SHAPES: dict[str, tuple[int, ...]] = {
    "means": (3,),
    "log_scales": (3,),
    "quats": (4,),
    "logit_opacities": (),
    "sh0": (1, 3),
    "sh_rest": (-1, 3),
}
"""Shape of each parameter without its first dimension, the number of Gaussians; -1 is any size."""


def require_cloud(
    state: Mapping[str, Any],
    names: Mapping[str, str],
    what: str,
    *,
    allow_non_finite: bool = False,
) -> None:
    """Check the tensors of a cloud.

    Args:
        state: tensors by their name in the file.
        names: the name in ``state`` of each key of ``SHAPES``; those that ``state`` lacks are
            skipped.
        what: names the file in messages.
        allow_non_finite: accept NaN and infinity.

    Raises:
        UserError: there are no Gaussians, shapes don't agree, a tensor isn't floating point, or
            values are NaN or infinite.
    """
    found = {name: state[stored] for name, stored in names.items() if stored in state}
    means = found.get("means")
    if not isinstance(means, Tensor) or not means.dim() or not len(means):
        raise UserError(f"{what} holds no Gaussian in {names['means']}")
    for name, value in found.items():
        where, wanted = f"{what}: {names[name]}", (len(means), *SHAPES[name])
        shape = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        sides = tuple(-1 if side < 0 else found for found, side in zip(shape, wanted, strict=False))
        if len(shape) != len(wanted) or sides != wanted:
            expected = ", ".join("K" if side < 0 else str(side) for side in wanted)
            raise UserError(f"{where} has the shape {shape}; expected ({expected})")
        if not value.is_floating_point() or value.layout != torch.strided:
            raise UserError(f"{where} is of the type {value.dtype}; expected floating point")
        bad = 0 if allow_non_finite else int((~value.isfinite()).sum())
        if bad:
            raise UserError(f"{where} holds {bad} numbers that are NaN or infinite")
    bands = 1 + found["sh_rest"].shape[1] if "sh_rest" in found else 1
    if isqrt(bands) ** 2 != bands:
        raise UserError(f"{what}: {bands} harmonics are no whole degree: expected 1, 4, 9 or 16")
