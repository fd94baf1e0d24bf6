"""Differentiable splatting of 3-D Gaussians: one formula, several executions."""

from .api import PRESETS, available_backends, rasterize
from .options import RasterizeOptions
from .output import Rasterized

__all__ = ["PRESETS", "Rasterized", "RasterizeOptions", "available_backends", "rasterize"]
