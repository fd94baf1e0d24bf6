"""``sog-exporter``: the Gaussians as an SOG file, the smallest format of PlayCanvas and SuperSplat.

The options are those of every exporter: see ``exporters/base.py``.

A Gaussian of degree 0 takes about 15 bytes; docs/formats.md has the PSNR that is lost by rounding.
The axes are those of the PLY, -y up."""

from dataclasses import dataclass, field

from ..host import register
from .base import SAVE_NAME, CloudExporter


@register("sog-exporter")
class SogExporter(CloudExporter):
    suffix = ".sog"

    @dataclass
    class Config(CloudExporter.Config):
        save_name: str = field(default="gaussians.sog", metadata=SAVE_NAME)

    cfg: Config
