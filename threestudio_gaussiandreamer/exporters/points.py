"""``points-exporter``: the centres of the Gaussians as a coloured point cloud, for programs that
don't support Gaussians.

===========  ==================================================================================
option       meaning
===========  ==================================================================================
save_name    name of the file in the export folder
min_opacity  skip Gaussians with a lower opacity; 0 keeps all. The order is preserved
save_video   also render the turntable
===========  ==================================================================================

The points are in the world's axes, z up, as programs for point clouds expect."""

from dataclasses import dataclass, field
from typing import List

from ..core.options import in_range
from ..gaussians.gaussians import opaque
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import sh0_colors
from ..host import ExporterOutput, register
from .base import SAVE_NAME, FileExporter


@register("points-exporter")
class PointsExporter(FileExporter):
    """One file of save_type "points"; its params are ``{"cloud": PointCloud}``."""

    @dataclass
    class Config(FileExporter.Config):
        save_name: str = field(default="points.ply", metadata=SAVE_NAME)
        min_opacity: float = field(default=0.0, metadata=in_range(0, 1))

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        gaussians = self.gaussians()
        gaussians = gaussians.rows(opaque(gaussians, self.cfg.min_opacity))
        cloud = PointCloud(points=gaussians.means, colors=sh0_colors(gaussians.sh[:, 0]))
        return [
            ExporterOutput(
                save_name=self.cfg.save_name, save_type="points", params={"cloud": cloud}
            )
        ]
