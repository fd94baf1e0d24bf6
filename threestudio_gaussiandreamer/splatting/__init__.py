"""Differentiable splatting of 3-D Gaussians: one image model, several backends."""

from .backends import available_backends, rasterize
from .scene import Rasterized, RasterizeOptions
from .validation import PRESETS

__all__ = ["PRESETS", "Rasterized", "RasterizeOptions", "available_backends", "rasterize"]
