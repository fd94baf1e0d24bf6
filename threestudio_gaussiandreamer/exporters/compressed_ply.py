"""``compressed-ply-exporter``: the Gaussians as PlayCanvas' compressed PLY, a quarter of the PLY's
size, for SuperSplat and other web viewers.

The options are those of every exporter: see ``exporters/base.py``.

A Gaussian of degree 0 takes 16.3 bytes; docs/formats.md has the PSNR that is lost by rounding. The
axes are those of the PLY, -y up."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("compressed-ply-exporter")
class CompressedPlyExporter(CloudExporter):
    suffix = ".compressed.ply"

    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.compressed.ply", metadata=SAVE_NAME)

    cfg: Config
