"""``spz-exporter``: the Gaussians as an SPZ file, a quarter of the PLY's size, for web viewers and
phones.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder
version      3, which all readers know, or 4, which is 4 to 9 % smaller and needs zstandard
save_video   also render the turntable
===========  ==================================================================================

A Gaussian takes about 17 bytes; docs/results.md has the PSNR that is lost by rounding. The file has
y up, as the SPZ format requires."""

from dataclasses import dataclass, field
from typing import List

from ..core.options import in_range
from ..formats.gaussian_files import StoredCloud
from ..formats.spz import VERSION
from ..formats.spz_container import VERSIONS, require_version
from ..host import ExporterOutput, register
from .base import SAVE_NAME, FileExporter


@register("spz-exporter")
class SpzExporter(FileExporter):
    """One file of save_type "spz"; its params are ``{"stored": StoredCloud, "version": int}``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="gaussians.spz", metadata=SAVE_NAME)
        version: int = field(default=VERSION, metadata=in_range(*VERSIONS))

        @staticmethod
        def check(cfg: "SpzExporter.Config") -> None:
            """Raise UserError if the version needs a package that isn't installed."""
            require_version(cfg.version)

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        params = {"stored": StoredCloud(self.gaussians()), "version": self.cfg.version}
        return [ExporterOutput(save_name=self.cfg.save_name, save_type="spz", params=params)]
