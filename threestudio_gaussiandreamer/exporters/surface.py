"""``surface-exporter``: the cloud's surface as a mesh with coloured vertices, an OBJ.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder; T3Bench looks for ``model.obj``
resolution   cells along the longest side of the object
level        share of the summed opacity's median at the centres at which the surface is; lower is
             thicker
save_video   also render the turntable
===========  ==================================================================================

The colours are those of the constant harmonic. A mesh loses what Gaussians show of hair, smoke and
glass."""

from dataclasses import dataclass
from typing import List

from ..core.errors import UserError
from ..gaussians.surface import gaussian_surface
from ..host import ExporterOutput, register, warn
from .base import FileExporter, gaussian_arrays


@register("surface-exporter")
class SurfaceExporter(FileExporter):
    """One file of save_type "surface"; its params are ``{"surface": Surface}``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = "model.obj"
        resolution: int = 128
        level: float = 0.5

        @staticmethod
        def check(cfg: "SurfaceExporter.Config") -> None:
            """Raises UserError for a value out of range."""
            FileExporter.Config.check(cfg)
            if not 8 <= cfg.resolution <= 512:
                raise UserError(f"resolution: expected 8 to 512 cells, got {cfg.resolution}")
            if not 0 < cfg.level <= 1:
                raise UserError(f"level: expected a share in (0, 1], got {cfg.level}")

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        surface = gaussian_surface(
            gaussian_arrays(self.geometry), resolution=self.cfg.resolution, level=self.cfg.level
        )
        if not len(surface.faces):
            warn("no Gaussian is opaque enough to be seen: the exported surface is empty")
        return [
            ExporterOutput(
                save_name=self.cfg.save_name, save_type="surface", params={"surface": surface}
            )
        ]
