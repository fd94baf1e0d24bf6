"""``surface-exporter``: the surface of the cloud as a mesh with vertex colours, an OBJ file.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder; T3Bench looks for ``model.obj``
up           the file's up axis: ``y`` (the front faces +z), as most programs read OBJ, or ``z`` for
             this package's world, which T3Bench expects
resolution   cells along the longest side of the object
level        isovalue of the surface, as a fraction of the median of the summed opacity at the
             centres of the Gaussians; lower values make the object thicker
save_video   also render the turntable
===========  ==================================================================================

The colours are those of the constant harmonic. A surface can't represent hair, smoke and glass as
Gaussians do."""

from dataclasses import dataclass, field
from typing import List

from ..core.options import in_range
from ..gaussians.axes import WORLD_UP, rotation_between
from ..gaussians.surface import gaussian_surface
from ..host import ExporterOutput, register, warn
from .base import SAVE_NAME, UP, FileExporter


@register("surface-exporter")
class SurfaceExporter(FileExporter):
    """One file of save_type "surface"; its params are ``{"surface": Surface}``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="model.obj", metadata=SAVE_NAME)
        up: str = field(default="y", metadata=UP)
        resolution: int = field(default=128, metadata=in_range(8, 512, "cells"))
        level: float = field(default=0.5, metadata=in_range(1e-6, 1))

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        surface = gaussian_surface(
            self.gaussians(), resolution=self.cfg.resolution, level=self.cfg.level
        )
        if not len(surface.faces):
            warn("no Gaussian is opaque enough to be seen: the exported surface is empty")
        surface = surface.rotated(rotation_between(WORLD_UP, self.cfg.up))
        return [
            ExporterOutput(
                save_name=self.cfg.save_name, save_type="surface", params={"surface": surface}
            )
        ]
