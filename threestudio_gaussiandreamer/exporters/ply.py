"""``ply-exporter``: the Gaussians as a PLY file in the format of 3D Gaussian splatting viewers.

==============  ===================================================================================
option          meaning
==============  ===================================================================================
save_name       name of the file in the export folder
up              the file's up axis: ``-y``, which all viewers expect (the front then faces their
                default camera), ``z`` for this package's world, or ``y``
pad_sh_degree   append zero harmonics up to this degree, for importers that require degree 3
save_video      also render the turntable
==============  ===================================================================================
"""

from dataclasses import dataclass, field
from typing import List, Optional

import numpy as np

from ..core.options import in_range
from ..formats.gaussian_files import StoredCloud
from ..formats.ply import padded_sh
from ..gaussians.axes import VIEWER_UP
from ..host import ExporterOutput, register
from .base import SAVE_NAME, UP, FileExporter


@register("ply-exporter")
class PlyExporter(FileExporter):
    """One file of save_type "ply"; its params are ``{"stored": StoredCloud}``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="gaussians.ply", metadata=SAVE_NAME)
        up: str = field(default=VIEWER_UP, metadata=UP)
        pad_sh_degree: Optional[int] = field(default=None, metadata=in_range(0, 3))

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        stored = StoredCloud(self.gaussians()).in_axes(self.cfg.up)
        if self.cfg.pad_sh_degree is not None:
            sh = np.ascontiguousarray(padded_sh(stored.gaussians.sh, self.cfg.pad_sh_degree))
            stored = stored._replace(gaussians=stored.gaussians._replace(sh=sh))
        return [
            ExporterOutput(save_name=self.cfg.save_name, save_type="ply", params={"stored": stored})
        ]
