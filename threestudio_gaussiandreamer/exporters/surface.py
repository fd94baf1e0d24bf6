"""``surface-exporter``: the cloud's surface as a mesh with coloured vertices, an OBJ.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder; T3Bench looks for ``model.obj``
up           the file's axis that is up: ``y`` (the front towards +z), as most programs read OBJ, or
             ``z`` for this package's world, which T3Bench expects
resolution   cells along the longest side of the object
level        share of the summed opacity's median at the centres at which the surface is; lower is
             thicker
save_video   also render the turntable
===========  ==================================================================================

The colours are those of the constant harmonic. A mesh loses what Gaussians show of hair, smoke and
glass."""

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
