"""``usda-exporter``: the Gaussians as USD text, for Omniverse, Houdini and other programs that read
OpenUSD 26.03.

The options are those of every exporter: see ``exporters/base.py``. A ``save_name`` that ends with
.usdz makes a USDZ, which phones open.

Nothing is rounded; y is up. The file is about three times as large as the PLY."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("usda-exporter")
class UsdaExporter(CloudExporter):
    suffix, variants = ".usda", (".usdz",)

    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.usda", metadata=SAVE_NAME)

    cfg: Config
