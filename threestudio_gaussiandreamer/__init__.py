"""GaussianDreamer: from a text prompt to a cloud of 3D Gaussians.

Importing this package is cheap and registers nothing. :func:`register_parts` imports the parts
(priors, geometry, renderer, guidances, exporters, system), whose decorators enter them into the
registry of the host."""

__version__ = "0.1.0"


def register_parts() -> None:
    """Import every module that registers a part; calling it again does nothing."""
    from .launch import parts  # noqa: F401
