"""Variants of score distillation, one per file; importing this package registers all of them."""

from importlib import import_module
from pkgutil import iter_modules

from .base import Variant

__all__ = ["Variant"]

for module in iter_modules(__path__):
    import_module(f".{module.name}", __name__)
