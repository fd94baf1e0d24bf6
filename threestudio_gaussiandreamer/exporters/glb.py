"""``glb-exporter``: the Gaussians as a GLB with KHR_gaussian_splatting, for Babylon.js and
PlayCanvas.

The options are those of every exporter: see ``exporters/base.py``. A ``save_name`` that ends with
.spz.glb has SPZ inside, the only kind that CesiumJS reads.

Without that nothing is rounded, and programs without the extension show points. y is up, as glTF
requires."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("glb-exporter")
class GlbExporter(CloudExporter):
    suffix, variants = ".glb", (".spz.glb",)

    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.glb", metadata=SAVE_NAME)

    cfg: Config
