"""Check the arguments of `rasterize`, and convert them to a `Scene`."""

import math
from numbers import Integral, Real
from typing import Optional

import torch
from torch import Tensor

from ..core.errors import UserError, unknown
from .options import RasterizeOptions
from .scene import Scene

PRESETS = {"fast": 1 / 255, "balanced": 1 / 1024, "accurate": 1 / 65536}
LARGEST_SIDE = 16 * (2**16 - 1)  # pixels; kernels number tiles and their ends with 16 bits
ROUNDING = 1e-4  # how far scales and opacities may lie outside their ranges
GAUSSIANS = ("means", "quats", "scales", "opacities", "colors")


def smallest_alpha(preset: str, alpha_min: Optional[float]) -> float:
    """Return ``alpha_min``, or the preset's value if it is None.

    Raises:
        UserError: there is no such preset.
    """
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return PRESETS[preset] if alpha_min is None else alpha_min


def named(means, quats, scales, opacities, colors, viewmats, Ks, background) -> dict[str, Tensor]:
    """Return the tensors by name, the Gaussians' first; a background of None is left out."""
    gaussians = (means, quats, scales, opacities, colors)
    tensors = dict(zip(GAUSSIANS, gaussians, strict=True)) | {"viewmats": viewmats, "Ks": Ks}
    return tensors if background is None else tensors | {"background": background}


def check(
    tensors: dict[str, Tensor], width: int, height: int, options: RasterizeOptions, policy: str
) -> None:
    """Check all arguments of `rasterize` except the backend.

    Raises:
        UserError: a tensor has the wrong type, device or shape, a number is out of its range, or,
            with the policy "error", a value isn't finite.
    """
    check_tensors(tensors)
    check_shapes(tensors)
    check_numbers(width, height, options)
    check_finite(policy, tensors)
    check_ranges(tensors)


def as_scene(tensors: dict[str, Tensor], width: int, height: int) -> Scene:
    """Convert checked tensors to contiguous float32, or to float64 if all Gaussians' tensors are.

    Cameras and background may have another type than the Gaussians.

    Raises:
        UserError: some Gaussians' tensors are float64 and others aren't.
    """
    wide = [name for name in GAUSSIANS if tensors[name].dtype == torch.float64]
    if wide and len(wide) < len(GAUSSIANS):
        raise UserError(
            f"{', '.join(GAUSSIANS)} must all be float64 or none of them; float64 here: "
            f"{', '.join(wide)}."
        )
    dtype = torch.float64 if wide else torch.float32
    tensors = {name: tensor.to(dtype).contiguous() for name, tensor in tensors.items()}
    views, channels = len(tensors["viewmats"]), tensors["colors"].shape[-1]
    background = tensors.get("background")
    if background is None:
        background = tensors["means"].new_zeros(views, channels)
    tensors["background"] = background.expand(views, -1).contiguous()
    tensors["Ks"] = tensors["Ks"].detach()
    return Scene(**tensors, width=int(width), height=int(height))


def check_tensors(tensors: dict[str, Tensor]) -> None:
    """Check that all are floating-point tensors on the device of the means.

    Raises:
        UserError: one isn't.
    """
    for name, tensor in tensors.items():
        if not isinstance(tensor, Tensor):
            raise UserError(f"{name} must be a torch.Tensor; got {type(tensor).__name__}.")
        if not tensor.is_floating_point():
            raise UserError(
                f"{name} must be floating point; got {tensor.dtype}. Convert it with .float()."
            )
        if tensor.device != tensors["means"].device:
            raise UserError(
                f"{name} must be on the device of means ({tensors['means'].device}); got "
                f"{tensor.device}."
            )
        if tensor.is_meta:
            raise UserError(f"{name} is on the device meta, and has no values to draw.")


def check_shapes(tensors: dict[str, Tensor]) -> None:
    """Check shapes, with N from the means, B from the viewmats and C from the colours.

    Raises:
        UserError: a shape doesn't match, or there is no view or no channel.
    """
    n, views = _length(tensors, "means", "(N, 3)"), _length(tensors, "viewmats", "(B, 4, 4)")
    channels = tensors["colors"].shape[-1] if tensors["colors"].dim() else 0
    if views == 0 or channels == 0:
        got = f"viewmats {_shape(tensors['viewmats'])}, colors {_shape(tensors['colors'])}"
        raise UserError(f"at least one view and one colour channel are needed; got {got}.")
    expected = {
        "means": [("(N, 3)", (n, 3))],
        "quats": [("(N, 4)", (n, 4))],
        "scales": [("(N, 3)", (n, 3))],
        "opacities": [("(N,)", (n,))],
        "colors": [("(N, C)", (n, channels)), ("(B, N, C)", (views, n, channels))],
        "viewmats": [("(B, 4, 4)", (views, 4, 4))],
        "Ks": [("(B, 3, 3)", (views, 3, 3))],
        "background": [("(C,)", (channels,)), ("(B, C)", (views, channels))],
    }
    for name, tensor in tensors.items():
        if tuple(tensor.shape) not in [shape for _, shape in expected[name]]:
            wanted = " or ".join(f"{words} = {shape}" for words, shape in expected[name])
            sizes = f"N={n} is from means, B={views} from viewmats, C={channels} from colors"
            raise UserError(f"{name} must have the shape {wanted}; got {_shape(tensor)}. {sizes}.")


def _length(tensors: dict[str, Tensor], name: str, wanted: str) -> int:
    if tensors[name].dim() == 0:
        raise UserError(f"{name} must have the shape {wanted}; got a single number.")
    return tensors[name].shape[0]


def _shape(tensor: Tensor) -> str:
    return str(tuple(tensor.shape))


def check_numbers(width: int, height: int, options: RasterizeOptions) -> None:
    for name, size in (("width", width), ("height", height)):
        if not _is_whole(size) or not 1 <= size <= LARGEST_SIDE:
            raise UserError(
                f"{name} must be a whole number of pixels, at least 1 and at most "
                f"{LARGEST_SIDE}; got {size!r}."
            )
        if (
            not _is_whole(options.downsample)
            or options.downsample not in (1, 2)
            or size % options.downsample
        ):
            raise UserError(
                "downsample must be 1 or 2 and divide the size; got "
                f"downsample={options.downsample!r} with {name}={size}."
            )
    for name in ("near", "far", "eps2d", "alpha_min", "alpha_max", "stop"):
        if not isinstance(getattr(options, name), Real):
            raise UserError(f"{name} must be a number; got {getattr(options, name)!r}.")
    ranges = {
        "near, far": (
            0 < options.near < options.far,
            "0 < near < far",
            (options.near, options.far),
        ),
        "eps2d": (0 <= options.eps2d < float("inf"), "a finite number >= 0", options.eps2d),
        "alpha_min": (0 <= options.alpha_min < 1, "in [0, 1)", options.alpha_min),
        "alpha_max": (
            options.alpha_min < options.alpha_max <= 1,
            "in (alpha_min, 1]",
            options.alpha_max,
        ),
        "stop": (0 <= options.stop < 1, "in [0, 1)", options.stop),
    }
    for name, (holds, wanted, got) in ranges.items():
        if not holds:
            raise UserError(f"{name} must be {wanted}; got {got}.")


def check_ranges(tensors: dict[str, Tensor]) -> None:
    """Check that scales and opacities aren't their logarithms and logits: on a CPU in every call,
    elsewhere in the first one on each device, since looking waits for it.

    Raises:
        UserError: a scale is below 0, or an opacity outside [0, 1]. Values that aren't finite are
            left to the policy.
    """
    device = tensors["means"].device
    if device in _looked_at or not len(tensors["means"]):
        return
    if device.type != "cpu":
        _looked_at.add(device)
    for name, most, wanted, hint in (
        ("scales", math.inf, "0 or more", "exp() of logarithms"),
        ("opacities", 1 + ROUNDING, "in [0, 1]", "sigmoid() of logits"),
    ):
        low, high = (value.item() for value in tensors[name].detach().aminmax())
        for found in (low, high):
            if math.isfinite(found) and not -ROUNDING <= found <= most:
                raise UserError(f"{name} must be {wanted}, but one is {found:g}: pass {hint}.")


_looked_at: set[torch.device] = set()


def _is_whole(number) -> bool:
    return isinstance(number, Integral) and not isinstance(number, bool)


def check_finite(policy: str, tensors: dict[str, Tensor]) -> None:
    if policy not in ("drop", "error"):
        raise unknown("non_finite policy", policy, ("drop", "error"))
    if policy == "error":
        for name, tensor in tensors.items():
            if (
                tensor.detach().sum().isfinite()
            ):  # a finite sum implies finite values, so the usual case takes one pass
                continue
            bad = (~tensor.isfinite()).nonzero()
            if len(bad):
                first = tuple(bad[0].tolist())
                raise UserError(
                    f"{name} holds {len(bad)} values that aren't finite, the first at {first}: "
                    f"{tensor[first].item()}."
                )
