"""``spz-exporter``: the Gaussians as an SPZ file, a quarter of the PLY's size, for web viewers and
phones.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder
save_video   also render the turntable
===========  ==================================================================================

About 17 bytes a Gaussian; what its rounding costs is in docs/results.md. The cloud is turned from
z up to y up, SPZ's axes."""

from dataclasses import dataclass, field
from typing import List

from ..gaussians.gaussians import usable
from ..host import ExporterOutput, register, warn
from .base import SAVE_NAME, FileExporter, gaussian_arrays


@register("spz-exporter")
class SpzExporter(FileExporter):
    """One file of save_type "spz"; its params are the arrays of the Gaussians, z up."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="gaussians.spz", metadata=SAVE_NAME)

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        arrays = gaussian_arrays(self.geometry)
        keep = usable(arrays)
        if not keep.all():
            warn(
                f"{(~keep).sum()} of {len(keep)} Gaussians hold NaN or infinity, which "
                f"{self.cfg.save_name} can't: left out"
            )
        params = {name: values[keep] for name, values in arrays._asdict().items()}
        return [ExporterOutput(save_name=self.cfg.save_name, save_type="spz", params=params)]
