"""The compiled pass of score distillation towards one known picture per render."""

import ctypes
import functools
from collections.abc import Callable, Sequence
from typing import Optional

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...core.errors import UserError
from ..scene import address
from .backend import library


class _Pictures(ctypes.Structure):
    """``SplatKnownPictures`` of scene.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in "render pictures background scale weight".split()),
        *((name, ctypes.c_int64) for name in "items height width".split()),
        ("threads", ctypes.c_int32),
        ("slope", ctypes.c_float),
    ]


class _Gradient(ctypes.Structure):
    """``SplatKnownGradient`` of scene.h."""

    _fields_ = [("gradient", ctypes.c_void_p), ("squares", ctypes.c_void_p)]


def is_available(device: torch.device) -> bool:
    """Return whether there is a pass for tensors on ``device``."""
    return device.type == "cpu" and _function() is not None


def known_gradient(
    render: Float[Tensor, "B H W 3"],
    pictures: Sequence[UInt8[Tensor, "4 H W"]],
    background: Float[Tensor, "B 3"],
    scale: Float[Tensor, " B"],
    weight: Float[Tensor, " B"],
) -> Optional[tuple[Float[Tensor, "B H W 3"], Float[Tensor, " B"]]]:
    """Compute the gradient of the loss 0.5 sum g^2 / B with respect to the renders, where
    g = w s (x - x_1) is the gradient of score distillation with respect to the latent
    x = 2 render - 1, and x_1 the latent of a picture on the background.

    Args:
        pictures: one per render, premultiplied.
        scale: s, of the error of the latent.
        weight: w.

    Returns:
        the gradient, 2 g / B, bit for bit that of plain torch, and the sum of g^2 per item,
        float64; None where the library or the tensors aren't of the kind that it takes.
    """
    float32 = (render, background, scale, weight)
    taken = all(x.dtype == torch.float32 and x.is_contiguous() for x in float32)
    taken = taken and all(picture.is_contiguous() for picture in pictures)
    if not (is_available(render.device) and taken):
        return None
    items, height, width, _ = render.shape
    gradient = torch.empty_like(render)
    squares = torch.empty(items, height, dtype=torch.float64)
    planes = (ctypes.c_void_p * items)(*map(address, pictures))
    inputs = address(render), ctypes.addressof(planes), *map(address, (background, scale, weight))
    rest = (items, height, width, torch.get_num_threads(), 2 / max(items, 1))
    failed = _function()(_Pictures(*inputs, *rest), _Gradient(*map(address, (gradient, squares))))
    return None if failed else (gradient, squares.sum(1))  # out of memory


@functools.cache
def _function() -> Optional[Callable[..., int]]:
    """Return the function of the library; None if it isn't built, or older than the function."""
    try:
        function = library().splat_gradients_to_pictures
    except (OSError, UserError, AttributeError):
        return None
    function.argtypes = [ctypes.POINTER(_Pictures), ctypes.POINTER(_Gradient)]
    function.restype = ctypes.c_int64
    return function
