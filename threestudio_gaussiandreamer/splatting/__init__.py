"""Differentiable splatting of 3-D Gaussians: one image model, several backends."""

from .api import rasterize
from .backends import available_backends
from .options import RasterizeOptions
from .output import Rasterized
from .validation import PRESETS

__all__ = ["PRESETS", "Rasterized", "RasterizeOptions", "available_backends", "rasterize"]
