"""Options that are passed to every splatting backend."""

from dataclasses import dataclass

NO_ALPHA_MIN = 2.0**-100
"""Value for compiled kernels if ``alpha_min`` is 0; smaller alphas don't change a float32 image."""


@dataclass(frozen=True)
class RasterizeOptions:
    """Constants of the image model; `splatting.rasterize` documents each one."""

    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    antialias: bool = False
    alpha_min: float = 1 / 1024
    alpha_max: float = 1 - 2**-10
    stop: float = 1e-4
    downsample: int = 1
    absgrad: bool = False

    @property
    def kernel_alpha_min(self) -> float:
        """Return a positive ``alpha_min``, since compiled kernels take its logarithm."""
        return max(self.alpha_min, 2 * NO_ALPHA_MIN) if self.alpha_min > 0 else NO_ALPHA_MIN
