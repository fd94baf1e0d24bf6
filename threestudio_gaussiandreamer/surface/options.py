"""The options of the conversion from Gaussians to a textured mesh."""

from dataclasses import dataclass, field
from typing import Optional

from ..core.errors import UserError
from ..core.memory import require_memory
from ..core.options import Rule, at_least, in_range, one_of, satisfies
from .unwrap import faces_that_fit

METHODS = ("fusion", "density")
VIEW_BYTES = 5
"""Memory per pixel of a view: colour and opacity, and one byte of work."""
TEXEL_BYTES = 150
"""Memory per texel while its colours are averaged and gaps are filled."""


def whole(low: int, high: int, unit: str) -> Rule:
    """Accept whole numbers from ``low`` to ``high``."""
    return satisfies(
        f"a whole number from {low} to {high} ({unit})",
        lambda v: isinstance(v, int) and not isinstance(v, bool) and low <= v <= high,
    )


@dataclass
class MeshOptions:
    """Size of the mesh and of its texture, and the renders of the cloud that both are made from."""

    faces: int = field(default=5000, metadata=whole(100, 100_000, "triangles"))
    texture: int = field(default=1024, metadata=whole(64, 8192, "texels each way"))
    method: str = field(default="fusion", metadata=one_of(METHODS))
    """``fusion`` of rendered depths, or a level set of the summed ``density`` of the Gaussians."""
    resolution: int = field(default=144, metadata=whole(16, 256, "cells"))
    """Cells along the longest side of the cloud, from which the surface is extracted."""
    views: int = field(default=64, metadata=whole(8, 1024, "renders"))
    """Renders on a sphere around the cloud, for depths and colours."""
    view_size: int = field(default=512, metadata=whole(64, 2048, "pixels each way"))
    min_component: float = field(default=0.01, metadata=in_range(0, 0.5))
    """Connected parts with a smaller share of the surface's area are dropped."""
    eps2d: Optional[float] = field(default=None, metadata=at_least(0, "square pixels"))
    """Screen-space dilation that the cloud was trained with, square pixels; None for the value of
    most viewers.
    """
    antialias: Optional[bool] = None
    """Whether the cloud was trained with antialiasing; None for no."""

    @staticmethod
    def check(cfg: "MeshOptions") -> None:
        """Check that the texture has room for the faces, and the memory.

        Raises:
            UserError: it hasn't, or the renders or the texture don't fit into memory.
        """
        fit = faces_that_fit(cfg.texture)
        if cfg.faces > fit:
            raise UserError(
                f"faces: a texture of {cfg.texture} x {cfg.texture} texels has room for {fit} "
                f"faces, not {cfg.faces}; take fewer faces or a larger texture"
            )
        pictures = f"{cfg.views} renders of {cfg.view_size} x {cfg.view_size} pixels"
        require_memory("view_size", VIEW_BYTES * cfg.views * cfg.view_size**2, pictures)
        texels = f"a texture of {cfg.texture} x {cfg.texture} texels"
        require_memory("texture", TEXEL_BYTES * cfg.texture**2, texels)
