"""``gaussians-prior``: a trained cloud of Gaussians (the PLY of any 3DGS program) as the start.

============  ======================================================================================
option        meaning
============  ======================================================================================
path          the PLY file
min_opacity   leave out Gaussians fainter than this, in [0, 1]
ground, ...   see ``priors/base.py``; not with all attributes
============  ======================================================================================

Called as any prior it gives the centres and the colours of the constant harmonic, to be grown and
sized anew; the geometry may instead take every attribute from :meth:`GaussiansPrior.gaussians` and
go on where that training stopped.

Limits: the prompt is not read; positions stay as they are (world units, z up): no turning, no
scaling."""

from dataclasses import dataclass, field

import numpy as np

from ..core.errors import UserError
from ..core.files import existing_file
from ..core.options import in_range
from ..formats.ply import read_gaussians
from ..gaussians.gaussians import Gaussians, opaque, usable
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import sh0_colors
from ..host import register
from .base import PATH, Prior, report_non_finite


@register("gaussians-prior")
class GaussiansPrior(Prior):
    """The Gaussians of a PLY file."""

    @dataclass
    class Config(Prior.Config):
        path: str = field(default="", metadata=PATH)
        min_opacity: float = field(default=0.0, metadata=in_range(0, 1))

    cfg: Config

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        return self.cloud(self._read())

    def gaussians(self, prompt: str) -> Gaussians:
        """Every attribute of the trained Gaussians, whatever the prompt.

        Raises:
            UserError: missing, damaged or empty, as :meth:`__call__`; or ``ground``, which has no
                trained attributes.
        """
        if self.cfg.ground:
            raise UserError(
                "ground: ground points have no trained attributes; set "
                "system.geometry.keep_attributes=false, or ground=false"
            )
        return self._read()

    @staticmethod
    def cloud(arrays: Gaussians) -> PointCloud:
        """The coloured centres of Gaussians."""
        return PointCloud(points=arrays.means, colors=sh0_colors(arrays.sh[:, 0]))

    def _read(self) -> Gaussians:
        path = existing_file(self.cfg.path, "PLY file")
        arrays = read_gaussians(path, allow_non_finite=True)
        keep = usable(arrays)
        if bad := int((~keep).sum()):
            report_non_finite(bad, len(keep), str(path))
        keep &= opaque(arrays, self.cfg.min_opacity)
        if not keep.any():
            raise UserError(
                f"no Gaussians in {str(path)!r} with an opacity of {self.cfg.min_opacity} or "
                f"more, among {len(keep)}"
            )
        return arrays.rows(keep)
