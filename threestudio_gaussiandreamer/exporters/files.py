"""The exporters that write one file in a known format, registered as ``<format>-exporter``.

==============  =====================  ============================================================
format          file                   for
==============  =====================  ============================================================
ply             gaussians.ply          viewers of 3D Gaussian splatting
spz             gaussians.spz          web viewers and phones, a quarter of the PLY's size; y up
compressed-ply  gaussians.compressed…  SuperSplat and PlayCanvas, a quarter of the PLY's size; -y up
sog             gaussians.sog          PlayCanvas and SuperSplat, the smallest; -y up
glb             gaussians.glb          KHR_gaussian_splatting: Babylon.js, PlayCanvas; y up, nothing
                                       rounded. ``save_name=x.spz.glb`` has SPZ inside, the only
                                       kind that CesiumJS reads
usda            gaussians.usda         OpenUSD 26.03: Omniverse, Houdini; y up, nothing rounded.
                                       ``save_name=x.usdz`` makes a USDZ, which phones open
points          points.ply             programs without Gaussians: their centres, in the world's
                                       axes, z up
surface         model.obj              the surface with vertex colours, which T3Bench reads
==============  =====================  ============================================================

==============  ===================================================================================
option          meaning
==============  ===================================================================================
save_name       name of the file in the export folder
save_video      also render the turntable
up              (ply, surface) the file's up axis: ``-y`` for viewers of PLY, ``y`` (the front faces
                +z) for programs that read OBJ, or ``z`` for this package's world and T3Bench
pad_sh_degree   (ply) append zero harmonics up to this degree, for importers that require degree 3
version         (spz) 3, which all readers know, or 4, which is 4 to 9 % smaller and needs
                zstandard
min_opacity     (points) skip Gaussians with a lower opacity; 0 keeps all. The order is preserved
resolution      (surface) cells along the longest side of the object
level           (surface) isovalue, as a fraction of the median of the summed opacity at the centres
                of the Gaussians; lower values make the object thicker
==============  ===================================================================================

docs/formats.md has sizes and the PSNR that is lost by rounding. A surface can't represent hair,
smoke and glass as Gaussians do."""

from collections.abc import Callable, Sequence
from dataclasses import field, make_dataclass
from typing import Any, List, NamedTuple, Optional

import numpy as np

from ..core.options import in_range
from ..formats.gaussian_files import FORMATS, StoredCloud, suffix_of
from ..formats.ply import padded_sh
from ..formats.spz import VERSION
from ..formats.spz_container import VERSIONS, require_version
from ..gaussians.axes import VIEWER_UP, WORLD_UP, rotation_between
from ..gaussians.gaussians import Gaussians, opaque
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import sh0_colors
from ..gaussians.surface import gaussian_surface
from ..host import ExporterOutput, register, warn
from .base import SAVE_NAME, UP, FileExporter

Params = Callable[[Gaussians, Any], dict[str, Any]]
"""From Gaussians in the world's axes and an exporter's options to the arguments of the system's
``save_<save_type>``."""


def stored(suffix: str, *variants: str) -> Params:
    """Return a function for a format, a key of ``formats.gaussian_files.FORMATS``, or for one of
    ``variants`` that the extension of ``save_name`` selects instead.
    """

    def params(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
        named = suffix_of(cfg.save_name)
        chosen = named if named in variants else suffix
        return {"stored": StoredCloud(gaussians).in_axes(FORMATS[chosen].up), "suffix": chosen}

    return params


def ply(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    cloud = StoredCloud(gaussians).in_axes(cfg.up)
    if cfg.pad_sh_degree is not None:
        sh = np.ascontiguousarray(padded_sh(cloud.gaussians.sh, cfg.pad_sh_degree))
        cloud = cloud._replace(gaussians=cloud.gaussians._replace(sh=sh))
    return {"stored": cloud}


def points(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    gaussians = gaussians.rows(opaque(gaussians, cfg.min_opacity))
    return {"cloud": PointCloud(gaussians.means, sh0_colors(gaussians.sh[:, 0]))}


def surface(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    found = gaussian_surface(gaussians, resolution=cfg.resolution, level=cfg.level)
    if not len(found.faces):
        warn("no Gaussian is opaque enough to be seen: the exported surface is empty")
    return {"surface": found.rotated(rotation_between(WORLD_UP, cfg.up))}


class Format(NamedTuple):
    """A row of the table of formats."""

    save_name: str
    """Default of the option."""
    params: Params
    save_type: str = "gaussians"
    options: Sequence[tuple[str, Any, Any]] = ()
    """Name, type and field of options beside ``save_name`` and ``save_video``."""
    check: Callable[[Any], None] = lambda cfg: None
    """Raises UserError for options that can't be had."""


TABLE = {
    "ply": Format(
        "gaussians.ply",
        ply,
        "ply",
        [
            ("up", str, field(default=VIEWER_UP, metadata=UP)),
            ("pad_sh_degree", Optional[int], field(default=None, metadata=in_range(0, 3))),
        ],
    ),
    "spz": Format(
        "gaussians.spz",
        lambda gaussians, cfg: {"stored": StoredCloud(gaussians), "version": cfg.version},
        "spz",
        [("version", int, field(default=VERSION, metadata=in_range(*VERSIONS)))],
        lambda cfg: require_version(cfg.version),
    ),
    "compressed-ply": Format("gaussians.compressed.ply", stored(".compressed.ply")),
    "sog": Format("gaussians.sog", stored(".sog")),
    "glb": Format("gaussians.glb", stored(".glb", ".spz.glb")),
    "usda": Format("gaussians.usda", stored(".usda", ".usdz")),
    "points": Format(
        "points.ply",
        points,
        "points",
        [("min_opacity", float, field(default=0.0, metadata=in_range(0, 1)))],
    ),
    "surface": Format(
        "model.obj",
        surface,
        "surface",
        [
            ("up", str, field(default="y", metadata=UP)),
            ("resolution", int, field(default=128, metadata=in_range(8, 512, "cells"))),
            ("level", float, field(default=0.5, metadata=in_range(1e-6, 1))),
        ],
    ),
}
"""By name of the format."""


class TableExporter(FileExporter):
    """Base class of the exporters of ``TABLE``."""

    format: Format

    def __call__(self) -> List[ExporterOutput]:
        params = self.format.params(self.gaussians(), self.cfg)
        return [
            ExporterOutput(
                save_name=self.cfg.save_name, save_type=self.format.save_type, params=params
            )
        ]


for name, row in TABLE.items():
    title = name.title().replace("-", "") + "Exporter"
    space = {"check": staticmethod(row.check), "__module__": __name__}
    named = ("save_name", str, field(default=row.save_name, metadata=SAVE_NAME))
    config = make_dataclass(
        "Config", [named, *row.options], bases=(FileExporter.Config,), namespace=space
    )
    register(f"{name}-exporter")(type(title, (TableExporter,), {"format": row, "Config": config}))
