"""``glb-exporter``: the Gaussians as a GLB with KHR_gaussian_splatting, for Cesium, Babylon.js
and PlayCanvas.

The options are those of every exporter: see ``exporters/base.py``.

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
