"""``glb-exporter``: the Gaussians as a GLB with KHR_gaussian_splatting, for Cesium, Babylon.js
and PlayCanvas.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder
save_video   also render the turntable
===========  ==================================================================================

Nothing is rounded; y is up, as glTF requires. Programs without the extension show points."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("glb-exporter")
class GlbExporter(CloudExporter):
    suffix = ".glb"

    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.glb", metadata=SAVE_NAME)

    cfg: Config
