"""``ply-exporter``: the Gaussians as a PLY that every viewer of 3D Gaussian splatting reads.

==============  ===================================================================================
option          meaning
==============  ===================================================================================
save_name       name of the file in the export folder
pad_sh_degree   append zero harmonics up to this degree, for importers that insist on degree 3
save_video      also render the turntable
==============  ===================================================================================
"""

from dataclasses import dataclass, field
from typing import List, Optional

import numpy as np

from ..core.options import in_range
from ..formats.ply import padded_sh
from ..host import ExporterOutput, register
from .base import SAVE_NAME, FileExporter, gaussian_arrays


@register("ply-exporter")
class PlyExporter(FileExporter):
    """One file of save_type "ply"; its params are the arguments of ``ply.write_gaussians``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="gaussians.ply", metadata=SAVE_NAME)
        pad_sh_degree: Optional[int] = field(default=None, metadata=in_range(0, 3))

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        arrays = gaussian_arrays(self.geometry)
        if self.cfg.pad_sh_degree is not None:
            arrays = arrays._replace(
                sh=np.ascontiguousarray(padded_sh(arrays.sh, self.cfg.pad_sh_degree))
            )
        return [
            ExporterOutput(save_name=self.cfg.save_name, save_type="ply", params=arrays._asdict())
        ]
