"""Check the arguments of `rasterize`, and convert them to a `Scene`."""

import math
from numbers import Integral, Real
from typing import Any, Optional

import torch
from torch import Tensor

from ..core.errors import UserError, unknown
from .scene import RasterizeOptions, Scene

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


def checked_scene(
    tensors: dict[str, Tensor], width: int, height: int, options: RasterizeOptions, policy: str
) -> Scene:
    """Check all arguments of `rasterize` except the backend. Convert the tensors to
    contiguous float32, or to float64 if all Gaussians' tensors are; cameras and background, which
    may be left out, may have another type.

    Raises:
        UserError: a tensor has the wrong type, device or shape, a number is out of its range, some
            Gaussians' tensors are float64 and others aren't, or, with the policy "error", a value
            isn't finite.
    """
    _check_tensors(tensors)
    _check_numbers(width, height, options)
    if policy not in ("drop", "error"):
        raise unknown("non_finite policy", policy, ("drop", "error"))
    if policy == "error":
        _check_finite(tensors)
    check_ranges(tensors)
    wide = [name for name in GAUSSIANS if tensors[name].dtype == torch.float64]
    both = "all float64, or none of them"
    _require(len(wide) in (0, len(GAUSSIANS)), ", ".join(GAUSSIANS), both, f"{wide} as float64")
    dtype = torch.float64 if wide else torch.float32
    tensors = {name: tensor.to(dtype).contiguous() for name, tensor in tensors.items()}
    views, channels = len(tensors["viewmats"]), tensors["colors"].shape[-1]
    background = tensors.get("background")
    if background is None:
        background = tensors["means"].new_zeros(views, channels)
    tensors["background"] = background.expand(views, -1).contiguous()
    tensors["Ks"] = tensors["Ks"].detach()
    return Scene(**tensors, width=int(width), height=int(height))


def _check_tensors(tensors: dict[str, Tensor]) -> None:
    """Check types, devices and shapes; N is of the means, B of the viewmats, C of the colours."""
    device = getattr(tensors["means"], "device", None)
    for name, tensor in tensors.items():
        _require(isinstance(tensor, Tensor), name, "a torch.Tensor", type(tensor).__name__)
        kind = f"{tensor.dtype}: call .float()"
        _require(tensor.is_floating_point(), name, "floating point", kind)
        _require(tensor.device == device, name, f"on the device of means ({device})", tensor.device)
        _require(not tensor.is_meta, name, "on a real device", "the device meta, with no values")
        _require(tensor.dim(), name, "a tensor such as means (N, 3)", "a single number")
    shapes = {name: tuple(tensor.shape) for name, tensor in tensors.items()}
    n, views, channels = shapes["means"][0], shapes["viewmats"][0], shapes["colors"][-1]
    got = f"viewmats {shapes['viewmats']}, colors {shapes['colors']}"
    _require(views and channels, "views and colour channels", "one or more", got)
    expected = {
        "means": {"(N, 3)": (n, 3)},
        "quats": {"(N, 4)": (n, 4)},
        "scales": {"(N, 3)": (n, 3)},
        "opacities": {"(N,)": (n,)},
        "colors": {"(N, C)": (n, channels), "(B, N, C)": (views, n, channels)},
        "viewmats": {"(B, 4, 4)": (views, 4, 4)},
        "Ks": {"(B, 3, 3)": (views, 3, 3)},
        "background": {"(C,)": (channels,), "(B, C)": (views, channels)},
    }
    sizes = f"N={n} is from means, B={views} from viewmats, C={channels} from colors"
    for name, shape in shapes.items():
        if shape not in expected[name].values():
            wanted = " or ".join(f"{words} = {known}" for words, known in expected[name].items())
            _require(False, name, f"of the shape {wanted}", f"{shape}; {sizes}")


def _check_numbers(width: int, height: int, options: RasterizeOptions) -> None:
    o, whole = options, f"a whole number of pixels, at least 1 and at most {LARGEST_SIDE}"
    for name, size in (("width", width), ("height", height)):
        _require(_is_whole(size) and 1 <= size <= LARGEST_SIDE, name, whole, repr(size))
        got = f"downsample={o.downsample!r} with {name}={size}"
        divides = _is_whole(o.downsample) and o.downsample in (1, 2) and not size % o.downsample
        _require(divides, "downsample", "1 or 2 and divide the size", got)
    for name in ("near", "far", "eps2d", "alpha_min", "alpha_max", "stop"):
        value = getattr(o, name)
        _require(isinstance(value, Real), name, "a number", repr(value))
    _require(0 < o.near < o.far, "near, far", "0 < near < far", (o.near, o.far))
    _require(0 <= o.eps2d < math.inf, "eps2d", "a finite number >= 0", o.eps2d)
    _require(0 <= o.alpha_min < 1, "alpha_min", "in [0, 1)", o.alpha_min)
    _require(o.alpha_min < o.alpha_max <= 1, "alpha_max", "in (alpha_min, 1]", o.alpha_max)
    _require(0 <= o.stop < 1, "stop", "in [0, 1)", o.stop)


def _require(holds: Any, name: str, wanted: str, got: Any) -> None:
    if not holds:
        raise UserError(f"{name} must be {wanted}; got {got}.")


def _is_whole(number: Any) -> bool:
    return isinstance(number, Integral) and not isinstance(number, bool)


def check_ranges(tensors: dict[str, Tensor]) -> None:
    """Check that scales and opacities aren't their logarithms and logits: on a CPU in every call,
    elsewhere in the first one on each device, since looking waits for it. Values that aren't finite
    are left to the policy.
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
        for found in (value.item() for value in tensors[name].detach().aminmax()):
            within = -ROUNDING <= found <= most or not math.isfinite(found)
            _require(within, name, wanted, f"{found:g}: pass {hint}")


_looked_at: set[torch.device] = set()


def _check_finite(tensors: dict[str, Tensor]) -> None:
    for name, tensor in tensors.items():
        # a finite sum implies finite values, so that the usual case takes one pass
        if not tensor.detach().sum().isfinite() and len(bad := (~tensor.isfinite()).nonzero()):
            first = tuple(bad[0].tolist())
            found = f"{len(bad)} other values, the first at {first}: {tensor[first].item()}"
            _require(False, name, "finite", found)
