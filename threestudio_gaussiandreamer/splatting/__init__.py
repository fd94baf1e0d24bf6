"""Differentiable splatting of 3-D Gaussians: one image model, several backends."""

from .api import rasterize
from .backends import available_backends
from .scene import Rasterized, RasterizeOptions
from .validation import PRESETS

__all__ = ["PRESETS", "Rasterized", "RasterizeOptions", "available_backends", "rasterize"]
