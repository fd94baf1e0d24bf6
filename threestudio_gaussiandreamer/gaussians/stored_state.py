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
    count = len(found["means"]) if _has_rows(found.get("means")) else 0
    if not count:
        raise UserError(f"{what} holds no Gaussian in {names['means']}")
    for name, value in found.items():
        _require_rows(value, (count, *SHAPES[name]), f"{what}: {names[name]}")
        bad = 0 if allow_non_finite else int((~value.isfinite()).sum())
        if bad:
            raise UserError(f"{what}: {names[name]} holds {bad} numbers that are NaN or infinite")
    bands = 1 + found["sh_rest"].shape[1] if "sh_rest" in found else 1
    if isqrt(bands) ** 2 != bands:
        raise UserError(f"{what}: {bands} harmonics are no whole degree: expected 1, 4, 9 or 16")


def _has_rows(value: Any) -> bool:
    return isinstance(value, Tensor) and value.dim() > 0


def _require_rows(value: Any, shape: tuple[int, ...], what: str) -> None:
    found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
    if not isinstance(value, Tensor) or not _fits(value.shape, shape):
        expected = ", ".join("K" if side < 0 else str(side) for side in shape)
        raise UserError(f"{what} has the shape {found}; expected ({expected})")
    if not value.is_floating_point() or value.layout != torch.strided:
        raise UserError(f"{what} is of the type {value.dtype}; expected floating point")


def _fits(shape: torch.Size, expected: tuple[int, ...]) -> bool:
    return len(shape) == len(expected) and all(
        side == wanted or wanted < 0 for side, wanted in zip(shape, expected, strict=True)
    )
