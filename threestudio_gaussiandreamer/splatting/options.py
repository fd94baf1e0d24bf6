"""What every splatting backend is told."""

from dataclasses import dataclass

SMALLEST_ALPHA = (
    2.0**-100
)  # stands for alpha_min = 0 in kernels: below it a float32 image can't tell


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
