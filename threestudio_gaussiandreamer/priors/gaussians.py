"""``gaussians-prior``: trained Gaussians of any program as the start: PLY, SPZ, SOG, GLB, .splat.

============  ======================================================================================
option        meaning
============  ======================================================================================
path          the file, in any format that is read (docs/formats.md)
up            the file's axis that is up: ``z``, ``y``, ``-y``, or ``auto``: what the file says,
              else -y for a PLY, as other programs write it; SPZ and GLB are y up
producer      the program that wrote the file (docs/formats.md), instead of ``up``
normalize     centre the box of the centres and make its longest half side ``scale``; null: with a
              ``producer``
scale         half the longest side, world units, with ``normalize``
min_opacity   leave out Gaussians fainter than this, in [0, 1]
ground, ...   see ``priors/base.py``; not with all attributes
============  ======================================================================================

Called as any prior it gives the centres and the colours of the constant harmonic, from which points
are grown; the geometry may instead continue from all attributes. The prompt is not read."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Optional

import numpy as np

from ..core.errors import UserError
from ..core.files import existing_file
from ..core.options import in_range, one_of
from ..formats.compressed_ply import is_compressed_ply
from ..formats.gaussian_files import READ, conversion, read_stored, suffix_of
from ..formats.ply import is_gaussian_ply
from ..formats.producers import GAUSSIANS, from_producer, producer_axes
from ..gaussians.axes import AXES, WORLD_UP
from ..gaussians.gaussians import Gaussians, opaque, usable
from ..gaussians.grow import longest_side
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import COEFFICIENTS, sh0_colors
from ..host import register
from .base import FilePrior, report_non_finite

PLY_SUFFIXES = (".ply", ".compressed.ply")


@register("gaussians-prior")
class GaussiansPrior(FilePrior):
    """The Gaussians of a file."""

    @dataclass
    class Config(FilePrior.Config):
        up: str = field(default="auto", metadata=one_of(("auto", *AXES)))
        normalize: Optional[bool] = None
        min_opacity: float = field(default=0.0, metadata=in_range(0, 1))

        @staticmethod
        def check(cfg: Any) -> None:
            FilePrior.Config.check(cfg)
            if cfg.producer:
                producer_axes(cfg.producer, GAUSSIANS)

    cfg: Config

    def preflight(self) -> None:
        gaussian_file(self.cfg.path)

    def preflight_attributes(self) -> None:
        """Check that :meth:`gaussians` can run, as :meth:`preflight` does for the points.

        Raises:
            UserError: ``ground`` is set, whose points have no trained attributes.
        """
        if self.cfg.ground:
            raise UserError(
                "ground: ground points have no trained attributes; set "
                "system.geometry.keep_attributes=false, or ground=false"
            )

    def generate(self, prompt: str, generator: np.random.Generator) -> PointCloud:
        return self.cloud(self.gaussians(prompt))

    @staticmethod
    def cloud(arrays: Gaussians) -> PointCloud:
        """Return the coloured centres of Gaussians."""
        return PointCloud(points=arrays.means, colors=sh0_colors(arrays.sh[:, 0]))

    def gaussians(self, prompt: str) -> Gaussians:
        """Return every attribute of the trained Gaussians, whatever the prompt.

        Raises:
            UserError: missing, damaged or empty, as :meth:`__call__`.
        """
        path = gaussian_file(self.cfg.path)
        stored = read_stored(path, up=None if self.cfg.up == "auto" else self.cfg.up)
        harmonics = stored.gaussians.sh[:, : COEFFICIENTS[-1]]  # more can't be drawn
        stored = stored._replace(gaussians=stored.gaussians._replace(sh=harmonics))
        if self.cfg.producer:
            stored = from_producer(stored, self.cfg.producer, suffix_of(path.name))
        arrays = stored.in_axes(WORLD_UP).gaussians
        keep = usable(arrays)
        if bad := int((~keep).sum()):
            report_non_finite(bad, len(keep), str(path))
        keep &= opaque(arrays, self.cfg.min_opacity)
        if not keep.any():
            raise UserError(
                f"no Gaussians in {str(path)!r} with an opacity of {self.cfg.min_opacity} or "
                f"more, among {len(keep)}"
            )
        kept = arrays.rows(keep)
        return normalized(kept, self.cfg.scale) if self.normalizes else kept


def gaussian_file(path: str) -> Path:
    """Return the path of a file of Gaussians, of which no more than a PLY's header is read."""
    file = existing_file(path, "file of Gaussians")
    if suffix_of(file.name) in PLY_SUFFIXES:
        if not is_gaussian_ply(file) and not is_compressed_ply(file):
            read_stored(file)  # raises the error that says what else it is
    elif suffix_of(file.name) not in READ and not is_gaussian_ply(file):
        advice = conversion(file.name)
        if file.suffix.lower() == ".ckpt":
            advice = f"; export a checkpoint first, with --export and resume={str(file)!r}"
        raise UserError(
            f"file of Gaussians {str(file)!r}: {file.suffix or 'a name without extension'} isn't "
            f"one of the formats that are read: {', '.join(READ)}{advice}"
        )
    return file


def normalized(gaussians: Gaussians, scale: float) -> Gaussians:
    """Centre the box of the centres at the origin, with half its longest side ``scale``."""
    middle = (gaussians.means.min(axis=0) + gaussians.means.max(axis=0)) / 2
    factor = np.float32(scale / (longest_side(gaussians.means) / 2 or 1.0))
    log_scales = gaussians.log_scales + np.log(factor)
    return gaussians._replace(means=(gaussians.means - middle) * factor, log_scales=log_scales)
