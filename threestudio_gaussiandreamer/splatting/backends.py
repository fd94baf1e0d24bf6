"""`rasterize` checks its arguments, chooses a backend, and calls it; the table of backends."""

import functools
import logging
from dataclasses import dataclass
from types import ModuleType
from typing import Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.devices import without_autocast
from ..core.errors import UserError, unknown
from . import reference, torch_backend
from .cpu import backend as cpu
from .cuda import backend as cuda
from .cuda import proof
from .scene import Rasterized, RasterizeOptions
from .validation import checked_scene, smallest_alpha

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Backend:
    """A module with ``rasterize(scene, options)`` and, unless it runs everywhere,
    ``unavailable()``; the devices and types of tensors that it supports.

    ``proof`` is a module with ``failure(device)``, which compares the backend with plain torch on
    a device before it is first used there.
    """

    module: ModuleType
    devices: Optional[tuple[str, ...]] = None  # None: any
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    proof: Optional[ModuleType] = None

    def unavailable(self) -> Optional[str]:
        """Return why the backend can't run on this machine, or None if it can."""
        return None if self.devices is None else self.module.unavailable()

    def takes(self, tensor: Tensor) -> bool:
        of_device = self.devices is None or tensor.device.type in self.devices
        return of_device and tensor.dtype in self.dtypes

    def refuses(self, tensor: Tensor) -> Optional[str]:
        """Return why the backend can't be used with tensors like this one, or None if it can."""
        reason = self.unavailable()
        if reason is None and not self.takes(tensor):
            places, kinds = (" or ".join(map(str, x or ())) for x in (self.devices, self.dtypes))
            reason = f"it takes {kinds} on {places}, these are {tensor.dtype} on {tensor.device}"
        return self.proof.failure(tensor.device) if reason is None and self.proof else reason


# In order of preference for "auto", which never gets to "reference", since "torch" always runs.
BACKENDS = {
    "cpu": Backend(cpu, ("cpu",), (torch.float32,)),
    "cuda": Backend(cuda, ("cuda",), (torch.float32,), proof),
    "torch": Backend(torch_backend),
    "reference": Backend(reference),
}


def available_backends() -> dict[str, Optional[str]]:
    """Map the name of each backend to None, or to the reason why it can't run on this machine."""
    return {name: backend.unavailable() for name, backend in BACKENDS.items()}


def choose_backend(name: str, tensor: Tensor) -> Backend:
    """Return the backend with this name, or for "auto" the first one that supports the tensor;
    warn, once per reason, if a compiled one that supports it can't run.

    Raises:
        UserError: there is no backend with this name, or it can't run or doesn't support the
            tensor's device or type, or differs from plain torch on this device.
    """
    if name not in ("auto", *BACKENDS):
        raise unknown("backend", name, ["auto", *BACKENDS])
    if name == "auto":
        for known, backend in BACKENDS.items():
            if not backend.takes(tensor):
                continue
            reason = backend.refuses(tensor)
            if reason is None:
                return backend
            _warn_once(
                f"splatting in plain torch, many times slower than backend {known!r}, which "
                f"can't run: {reason}."
            )
    reason = BACKENDS[name].refuses(tensor)
    if reason is not None:
        usable = (known for known, other in BACKENDS.items() if other.refuses(tensor) is None)
        raise UserError(
            f"the backend {name!r} can't run: {reason}. Use backend='auto', or one of "
            f"{', '.join(usable)}."
        )
    return BACKENDS[name]


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)


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
        colors: any number of channels, shared by the views (N, C) or per view (B, N, C).
        viewmats: world to camera, OpenCV (x right, y down, z forward).
        Ks: intrinsics in pixels of the rendered size, pixel centres at +0.5; skew is ignored, and
            there is no gradient.
        width, height: rendered size in pixels, before downsampling.
        background: background colour, (C,) or (B, C); None is black.
        near, far: a Gaussian whose mean isn't strictly between these depths is dropped.
        eps2d: dilation, added to both screen-space variances, square pixels.
        antialias: reduce the opacity to compensate for the dilation, so that a small Gaussian
            keeps its energy at any distance.
        preset: smallest alpha that is blended: fast 1/255, balanced 1/1024, accurate 1/65536.
        alpha_min: smallest alpha that is blended; overrides the preset.
        alpha_max: largest alpha of one Gaussian in one pixel; no gradient above it.
        stop: the Gaussian that brings a pixel's transmittance below this is the last one blended.
        downsample: 1, or 2 to average 2 x 2 pixels after rendering.
        absgrad: also compute ``means2d.absgrad``, the sum over pixels of the absolute gradient.
        backend: "cpu", "cuda", "torch", "reference", or "auto", the fastest one for the tensors'
            device and type.
        non_finite: "drop" ignores Gaussians with NaN or infinity; "error" raises UserError.

    Returns:
        Rasterized: image, alpha, depth, means2d, radii, contribution. Always float32, or float64
            for float64 Gaussians.

    Raises:
        UserError: an argument has the wrong shape, type, device or value, or the backend can't run.

    `reference.py` and `projection.py` specify the image model.
    """
    alpha_min = smallest_alpha(preset, alpha_min)
    options = RasterizeOptions(
        near, far, eps2d, antialias, alpha_min, alpha_max, stop, downsample, absgrad
    )
    tensors = {"means": means, "quats": quats, "scales": scales, "opacities": opacities}
    tensors |= {"colors": colors, "viewmats": viewmats, "Ks": Ks}
    if background is not None:
        tensors["background"] = background
    scene = checked_scene(tensors, width, height, options, non_finite)
    with without_autocast(means.device.type):
        return choose_backend(backend, scene.means).module.rasterize(scene, options)
