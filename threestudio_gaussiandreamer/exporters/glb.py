"""``glb-exporter``: the Gaussians as a GLB with KHR_gaussian_splatting, for Babylon.js and
PlayCanvas, or with SPZ inside for Cesium.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder
spz          compress by KHR_gaussian_splatting_compression_spz_2, the only kind that CesiumJS reads
save_video   also render the turntable
===========  ==================================================================================

Without ``spz`` nothing is rounded, and programs without the extension show points. y is up, as glTF
requires."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("glb-exporter")
class GlbExporter(CloudExporter):
    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.glb", metadata=SAVE_NAME)
        spz: bool = False

    cfg: Config

    @property
    def suffix(self) -> str:
        return ".spz.glb" if self.cfg.spz else ".glb"
