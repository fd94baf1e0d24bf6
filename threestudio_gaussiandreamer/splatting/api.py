"""`rasterize`: checks what the user gave, chooses who computes it, and calls that backend."""

import functools
import importlib
import logging
from dataclasses import dataclass
from numbers import Integral, Real
from types import ModuleType
from typing import Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError, unknown
from .options import RasterizeOptions
from .output import Rasterized

PRESETS = {"fast": 1 / 255, "balanced": 1 / 1024, "accurate": 1 / 65536}
LARGEST_SIDE = 2**20  # pixels; kernels number the columns of their tiles with 16 bits
log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Backend:
    """A module of this package with ``rasterize`` and ``unavailable``, and what tensors it
    takes.
    """

    module: str
    devices: Optional[tuple[str, ...]] = None  # None: any
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)

    def load(self) -> ModuleType:
        return importlib.import_module(f".{self.module}", __package__)

    def refuses(self, tensor: Tensor) -> Optional[str]:
        """Why it can't take tensors like this one, or None."""
        if self.devices is not None and tensor.device.type not in self.devices:
            return f"it takes tensors on {' or '.join(self.devices)}, these are on {tensor.device}"
        if tensor.dtype not in self.dtypes:
            return f"it takes {' or '.join(map(str, self.dtypes))}, these are {tensor.dtype}"
        return self.load().unavailable()


# In order of preference for "auto"; the specification is only used when it is asked for.
BACKENDS = {
    "cpu": Backend("cpu.backend", devices=("cpu",), dtypes=(torch.float32,)),
    "cuda": Backend("cuda.backend", devices=("cuda",), dtypes=(torch.float32,)),
    "torch": Backend("torch_backend"),
    "reference": Backend("reference"),
}


def available_backends() -> dict[str, Optional[str]]:
    """Every backend by name with None, or with the reason why it can't run on this machine."""
    return {name: backend.load().unavailable() for name, backend in BACKENDS.items()}


def rasterize(
    means: Float[Tensor, "N 3"],
    quats: Float[Tensor, "N 4"],
    scales: Float[Tensor, "N 3"],
    opacities: Float[Tensor, " N"],
    colors: Float[Tensor, "... N C"],
    viewmats: Float[Tensor, "B 4 4"],
    Ks: Float[Tensor, "B 3 3"],
    width: int,
    height: int,
    *,
    background: Optional[Float[Tensor, "... C"]] = None,
    near: float = 0.01,
    far: float = 1e10,
    eps2d: float = 0.3,
    antialias: bool = False,
    preset: str = "balanced",
    alpha_min: Optional[float] = None,
    alpha_max: float = 1 - 2**-10,
    stop: float = 1e-4,
    downsample: int = 1,
    absgrad: bool = False,
    backend: str = "auto",
    non_finite: str = "drop",
) -> Rasterized:
    """Draw 3-D Gaussians into B pinhole views by front-to-back alpha compositing, differentiably.

    Args:
        means: world positions.
        quats: rotations wxyz, any length; zero means no rotation.
        scales: standard deviations along the rotated axes, world units (not their logarithms).
        opacities: in [0, 1].
        colors: any number of channels, of the Gaussians (N, C) or of each view (B, N, C).
        viewmats: world to camera, OpenCV (x right, y down, z forward).
        Ks: intrinsics in pixels of the size below, centres at +0.5; without skew and without
            gradient.
        width, height: pixels to render, before downsampling.
        background: colour behind everything, (C,) or (B, C); None is black.
        near, far: a Gaussian whose mean isn't strictly between these depths is dropped.
        eps2d: added to both variances on screen, square pixels.
        antialias: make up for that dilation in the opacity, so that a small Gaussian keeps its
            energy at any distance.
        preset: smallest alpha that counts: fast 1/255, balanced 1/1024, accurate 1/65536.
        alpha_min: that number itself, instead of a preset.
        alpha_max: largest alpha of one Gaussian in one pixel; no gradient above it.
        stop: a pixel is finished with the Gaussian that brings its transmittance below this.
        downsample: 2 averages 2 x 2 pixels after rendering.
        absgrad: also collect ``means2d.absgrad``, the sum over pixels of the absolute gradient.
        backend: "cpu", "cuda", "torch", "reference", or "auto": the fastest for where the tensors
            are.
        non_finite: "drop" ignores Gaussians that hold NaN or infinity; "error" names them.

    Returns:
        Rasterized: image, alpha, depth, means2d, radii, contribution. Always float32, or float64
            for float64 Gaussians.

    Raises:
        UserError: an argument has the wrong shape, type, device or value, or the backend can't run.

    The image model is the one of `reference.py` and `projection.py`.
    """
    options = RasterizeOptions(
        near,
        far,
        eps2d,
        antialias,
        _alpha_min(preset, alpha_min),
        alpha_max,
        stop,
        downsample,
        absgrad,
    )
    gaussians = {
        "means": means,
        "quats": quats,
        "scales": scales,
        "opacities": opacities,
        "colors": colors,
    }
    cameras = {"viewmats": viewmats, "Ks": Ks} | (
        {} if background is None else {"background": background}
    )
    _check_tensors(gaussians | cameras)
    _check_shapes(gaussians | cameras)
    _check_numbers(width, height, options)
    _check_finite(non_finite, gaussians | cameras)
    with torch.autocast(means.device.type, enabled=False):
        gaussians, cameras = _convert(gaussians, cameras)
        run = _choose(backend, gaussians["means"]).load().rasterize
        background = cameras.get("background")
        if background is not None:
            background = background.expand(len(viewmats), -1).contiguous()
        return run(
            *gaussians.values(),
            cameras["viewmats"],
            cameras["Ks"].detach(),
            int(width),
            int(height),
            background,
            options,
        )


def _alpha_min(preset: str, alpha_min: Optional[float]) -> float:
    if preset not in PRESETS:
        raise unknown("preset", preset, PRESETS)
    return PRESETS[preset] if alpha_min is None else alpha_min


def _check_tensors(tensors: dict[str, Tensor]) -> None:
    """All are floating-point tensors on the device of the means."""
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


def _check_shapes(tensors: dict[str, Tensor]) -> None:
    """N comes from the means, B from the viewmats, C from the colours."""
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


def _check_numbers(width: int, height: int, options: RasterizeOptions) -> None:
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


def _is_whole(number) -> bool:
    return isinstance(number, Integral) and not isinstance(number, bool)


def _check_finite(policy: str, tensors: dict[str, Tensor]) -> None:
    if policy not in ("drop", "error"):
        raise unknown("non_finite policy", policy, ("drop", "error"))
    if policy == "error":
        for name, tensor in tensors.items():
            if (
                tensor.detach().sum().isfinite()
            ):  # then all of them are: one fast pass settles the usual case
                continue
            bad = (~tensor.isfinite()).nonzero()
            if len(bad):
                first = tuple(bad[0].tolist())
                raise UserError(
                    f"{name} holds {len(bad)} values that aren't finite, the first at {first}: "
                    f"{tensor[first].item()}."
                )


def _convert(
    gaussians: dict[str, Tensor], cameras: dict[str, Tensor]
) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    """Everything contiguous and float32, or float64 where all Gaussians are; only the cameras are
    narrowed in silence.
    """
    wide = [name for name, tensor in gaussians.items() if tensor.dtype == torch.float64]
    if wide and len(wide) < len(gaussians):
        raise UserError(
            f"{', '.join(gaussians)} must all be float64 or none of them; float64 here: "
            f"{', '.join(wide)}."
        )
    dtype = torch.float64 if wide else torch.float32
    return tuple(
        {name: tensor.to(dtype).contiguous() for name, tensor in group.items()}
        for group in (gaussians, cameras)
    )


def _choose(name: str, tensor: Tensor) -> Backend:
    """The backend of that name, or for "auto" the first one that takes such tensors."""
    if name not in ("auto", *BACKENDS):
        raise unknown("backend", name, ["auto", *BACKENDS])
    refusals = {name: backend.refuses(tensor) for name, backend in BACKENDS.items()}
    usable = [name for name, reason in refusals.items() if reason is None]
    if name == "auto":
        _report_slow_path(usable[0], tensor)
    elif refusals[name] is not None:
        raise UserError(
            f"the backend {name!r} can't run: {refusals[name]}. Use backend='auto', or one of "
            f"{', '.join(usable)}."
        )
    return BACKENDS[usable[0] if name == "auto" else name]


def _report_slow_path(chosen: str, tensor: Tensor) -> None:
    """Say once for each reason that the kernel made for this device isn't used though the tensors
    would suit it.
    """
    for name, backend in BACKENDS.items():
        if (
            name != chosen
            and tensor.device.type in (backend.devices or ())
            and tensor.dtype in backend.dtypes
        ):
            _warn_once(
                f"splatting in plain torch, many times slower than backend {name!r}, which "
                f"can't run: {backend.refuses(tensor)}."
            )


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
