"""`rasterize`: checks its arguments, chooses a backend, and calls it."""

from typing import Optional

from jaxtyping import Float
from torch import Tensor

from ..core.devices import without_autocast
from .backends import choose_backend
from .scene import Rasterized, RasterizeOptions
from .validation import checked_scene, smallest_alpha


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
