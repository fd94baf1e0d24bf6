"""Exporters, which prepare the files of a run's cloud.

An exporter is a subclass of the host's ``Exporter``, registered as ``<format>-exporter``. A call
returns a list of ``ExporterOutput(save_name, save_type, params)``, and the system writes each with
its method ``save_<save_type>(name, **params)``. ``gaussiandreamer-exporter`` writes several
formats: those of docs/formats.md, points, surface, which T3Bench reads, and gaussiandreamer-mesh
(docs/mesh.md); threestudio has a ``mesh-exporter`` too.

==============  ===================================================================================
option          meaning
==============  ===================================================================================
formats         (gaussiandreamer) names of registered exporters without their ``-exporter``
options         (gaussiandreamer) options of single formats, such as ``{ply: {pad_sh_degree: 3}}``
save_video      (all) also render the turntable
save_name       name of the file in the export folder; a mesh's OBJ, MTL and PNG have its stem
up              (ply, surface, mesh, and gaussiandreamer for these) the file's up axis: ``-y`` for
                viewers of PLY, ``y`` for readers of OBJ, or ``z`` for this package and T3Bench
pad_sh_degree   (ply) append zero harmonics up to this degree, for importers that require degree 3
version         (spz) 3, which all readers know, or 4, smaller by 4 to 9 %, which needs zstandard
min_opacity     (points) skip Gaussians with a lower opacity; 0 keeps all. The order is preserved
resolution      (surface, mesh) cells along the longest side of the object
level           (surface) isovalue, a fraction of the median of the summed opacity at the Gaussians'
                centres; lower values make the object thicker
obj             (mesh) also write the OBJ with its MTL and PNG
unlit           (mesh) ask viewers to show the texture without lighting
faces, ...      (mesh) the options of ``surface/textured.py``
==============  ===================================================================================
"""

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
from typing import Any, Dict, List, Optional

import numpy as np

from ..core.errors import UserError
from ..core.options import RULE, Rule, each, in_range, one_of, require_mapping, wrong
from ..formats.gaussian_files import FORMATS, StoredCloud, suffix_of
from ..formats.glb import GLB_UP
from ..formats.spz import VERSION, VERSIONS, require_version
from ..gaussians.axes import AXES, VIEWER_UP, WORLD_UP, rotation_between
from ..gaussians.densify import LOG_SCALE_RANGE
from ..gaussians.gaussians import Gaussians, finite, opaque
from ..gaussians.point_cloud import PointCloud
from ..gaussians.sh import sh0_colors
from ..gaussians.surface import gaussian_surface
from ..gaussians.views import EPS2D
from ..host import (
    Exporter,
    ExporterOutput,
    find,
    names,
    parse_structured,
    register,
    register_builtin,
    warn,
)
from ..host.methods import find_method, require_dataclass, require_method
from ..surface.textured import MeshOptions, mesh_from_gaussians, require_mesh_libraries

SUFFIX = "-exporter"
NAME_BYTES = 255  # of the longest file name on common file systems
RESERVED = ("pruned", "report.json", "report.png", "view.html", "poster.png")
"""Names of other files that a run writes into the export folder."""


def require_file_name(option: str, name: str) -> None:
    """Raise UserError unless ``name``, the value of ``option``, can be a file's in the folder."""
    folders = not name or name != os.path.basename(name) or name in (os.curdir, os.pardir)
    long = "\0" in name or len(name.encode(errors="surrogateescape")) > NAME_BYTES
    if folders or long or name.casefold() in RESERVED:
        said = f"the name of a file, without folders, of at most {NAME_BYTES} bytes and no NUL"
        raise wrong(option, f"{said}, other than {', '.join(RESERVED)}", name)


SAVE_NAME, UP = {RULE: require_file_name}, one_of(AXES)
DRAWING = {"eps2d": EPS2D, "antialias": False}
"""Of a run's renderer: the dilation in square pixels of the image, and whether it antialiases."""


class FileExporter(Exporter):
    """Base class of exporters that write one file, or one in several formats."""

    @dataclass
    class Config(Exporter.Config):
        save_name: str = field(default="", metadata=SAVE_NAME)

    cfg: Config
    shared: Optional[Gaussians] = None
    """Set by the bundle exporter, which reads the Gaussians once for all formats."""
    drawing: Mapping[str, Any] = DRAWING
    """Set by the system before it calls the exporter."""

    def gaussians(self) -> Gaussians:
        """Return the Gaussians to export, in the world's axes; all values are finite."""
        return read_gaussians(self.geometry) if self.shared is None else self.shared


def read_gaussians(geometry: Any) -> Gaussians:
    """Read a geometry's Gaussians as float32; those that aren't finite are left out, and logged."""
    found = finite(Gaussians.of(geometry).arrays(), "export")
    return found._replace(log_scales=found.log_scales.clip(*LOG_SCALE_RANGE))  # as they are drawn


def require_export(exporter: type) -> None:
    """Raise UserError for a class of exporters that can't be called."""
    own = isinstance(exporter, type) and find_method(exporter, "__call__")
    if not own or own is find_method(Exporter, "__call__"):  # the host's only raises an error
        name = getattr(exporter, "__name__", type(exporter).__name__)
        raise UserError(f"{name} has no __call__(), which returns the files to write")
    require_method(exporter, "__call__")


def outputs_of(exporter: Exporter) -> list[ExporterOutput]:
    """Call an exporter; raise UserError if it returns no list of ExporterOutput."""
    found = exporter()
    is_list = isinstance(found, (list, tuple))
    if not is_list or not all(isinstance(entry, ExporterOutput) for entry in found):
        said = f"{type(exporter).__name__} returned {type(found).__name__}"
        raise UserError(f"{said}; expected a list of ExporterOutput")
    return list(found)


# ---- formats -------------------------------------------------------------------------------------

Params = Callable[[Gaussians, Any], dict[str, Any]]
"""From Gaussians in the world's axes and the options to the arguments of ``save_<save_type>``."""


def stored(suffix: str, *variants: str) -> Params:
    """Return a function for a key of ``FORMATS``, or of ``variants`` that ``save_name`` ends in."""

    def params(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
        named = suffix_of(cfg.save_name)
        chosen = named if named in variants else suffix
        return {"stored": StoredCloud(gaussians).in_axes(FORMATS[chosen].up), "suffix": chosen}

    return params


def ply(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    cloud = StoredCloud(gaussians).in_axes(cfg.up)
    if cfg.pad_sh_degree is not None:
        sh = cloud.gaussians.sh
        missing = max((cfg.pad_sh_degree + 1) ** 2 - sh.shape[1], 0)
        sh = np.pad(sh, ((0, 0), (0, missing), (0, 0)))
        cloud = cloud._replace(gaussians=cloud.gaussians._replace(sh=sh))
    return {"stored": cloud}


def spz(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    return {"stored": StoredCloud(gaussians), "version": cfg.version}


def points(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    gaussians = gaussians.rows(opaque(gaussians, cfg.min_opacity))
    return {"cloud": PointCloud(gaussians.means, sh0_colors(gaussians.sh[:, 0]))}


def surface(gaussians: Gaussians, cfg: Any) -> dict[str, Any]:
    found = gaussian_surface(gaussians, resolution=cfg.resolution, level=cfg.level)
    if not len(found.faces):
        warn("no Gaussian is opaque enough to be seen: the exported surface is empty")
    return {"surface": found.rotated(rotation_between(WORLD_UP, cfg.up))}


def add(
    name: str,
    save_name: str,
    params: Params,
    save_type: str = "gaussians",
    options: Sequence[tuple[str, Any, Any, Rule]] = (),
    check: Callable[[Any], None] = lambda cfg: None,
) -> None:
    """Register the exporter of a format, whose further ``options`` each have name, type, default
    and rule; ``check`` raises UserError for those that can't be had.
    """

    def call(self: FileExporter) -> List[ExporterOutput]:
        return [ExporterOutput(self.cfg.save_name, save_type, params(self.gaussians(), self.cfg))]

    given = [("save_name", str, save_name, SAVE_NAME), *options]
    given = [(name, kind, field(default=x, metadata=rule)) for name, kind, x, rule in given]
    space = {"check": staticmethod(check), "__module__": __name__}
    config = make_dataclass("Config", given, bases=(FileExporter.Config,), namespace=space)
    title = name.title().replace("-", "") + "Exporter"
    register(name + SUFFIX)(type(title, (FileExporter,), {"__call__": call, "Config": config}))


PADDING = ("pad_sh_degree", Optional[int], None, in_range(0, 3))
CELLS = ("resolution", int, 128, in_range(8, 512, "cells"))
LEVEL = ("level", float, 0.5, in_range(1e-6, 1))
WRITTEN = ("version", int, VERSION, in_range(*VERSIONS))
add("ply", "gaussians.ply", ply, "ply", [("up", str, VIEWER_UP, UP), PADDING])
add("spz", "gaussians.spz", spz, "spz", [WRITTEN], lambda cfg: require_version(cfg.version))
add("compressed-ply", "gaussians.compressed.ply", stored(".compressed.ply"))
add("sog", "gaussians.sog", stored(".sog"))
add("glb", "gaussians.glb", stored(".glb", ".spz.glb"))
add("usda", "gaussians.usda", stored(".usda", ".usdz"))
add("points", "points.ply", points, "points", [("min_opacity", float, 0.0, in_range(0, 1))])
add("surface", "model.obj", surface, "surface", [("up", str, "y", UP), CELLS, LEVEL])


@register("gaussiandreamer-mesh-exporter")
@register_builtin("mesh-exporter")
class MeshExporter(FileExporter):
    """Files of save_type "textured_mesh"; their params are ``{"mesh": Mesh, "unlit": bool}``."""

    @dataclass
    class Config(FileExporter.Config, MeshOptions):
        save_name: str = field(default="mesh.glb", metadata=SAVE_NAME)
        up: str = field(default="y", metadata=UP)
        obj: bool = True
        unlit: bool = False

        @staticmethod
        def check(cfg: "MeshExporter.Config") -> None:
            """Raise UserError unless name and options are right and the libraries are there."""
            if Path(cfg.save_name).suffix.lower() != ".glb":
                raise UserError(f"save_name: expected the name of a .glb, got {cfg.save_name!r}")
            MeshOptions.check(cfg)
            require_mesh_libraries()

    cfg: Config

    def __call__(self) -> List[ExporterOutput]:
        given = {option.name: getattr(self.cfg, option.name) for option in fields(MeshOptions)}
        given |= {key: x for key, x in self.drawing.items() if given[key] is None}
        mesh = mesh_from_gaussians(self.gaussians(), MeshOptions(**given))
        files = [(self.cfg.save_name, GLB_UP)]
        files += [(str(Path(self.cfg.save_name).with_suffix(".obj")), self.cfg.up)] * self.cfg.obj
        outputs = []
        for name, up in files:
            turned = mesh._replace(vertices=mesh.vertices @ rotation_between(WORLD_UP, up).T)
            params = {"mesh": turned, "unlit": self.cfg.unlit}
            outputs.append(ExporterOutput(name, "textured_mesh", params))
        return outputs


def available_formats() -> list[str]:
    """Return the formats: every registered exporter but the bundle itself."""
    exporters = [name.removesuffix(SUFFIX) for name in names() if name.endswith(SUFFIX)]
    return [name for name in exporters if name != "gaussiandreamer"]


@register("gaussiandreamer-exporter")
class BundleExporter(Exporter):
    """Export the files of all formats, in the order of ``formats``."""

    @dataclass
    class Config(Exporter.Config):
        formats: List[str] = field(
            default_factory=lambda: ["ply", "spz", "points"],
            metadata=each(one_of(available_formats)),
        )
        options: Dict[str, Any] = field(default_factory=dict)
        up: Optional[str] = field(default=None, metadata=UP)
        save_video: bool = True

        @staticmethod
        def check(cfg: "BundleExporter.Config") -> None:
            """Raise UserError for invalid options, options of a format that isn't in ``formats``,
            and two formats that write the same file, as names are on systems without case.
            """
            if unused := [name for name in cfg.options if name not in cfg.formats]:
                said = f"isn't in formats ({', '.join(cfg.formats)}), so its options have no effect"
                raise UserError(f"options.{unused[0]}: {unused[0]} {said}")
            writers: dict[str, str] = {}
            for name in cfg.formats:
                file = getattr(options_of(name, cfg), "save_name", f"{name}/")
                if (other := writers.setdefault(file.casefold(), name)) != name:
                    said = f"{file!r} is the file of the format {other}; choose another name"
                    raise UserError(f"options.{name}.save_name: {said}")

    cfg: Config
    drawing: Mapping[str, Any] = DRAWING

    def __call__(self) -> List[ExporterOutput]:
        return [output for outputs in self.by_format().values() for output in outputs()]

    def by_format(self) -> Dict[str, Callable[[], List[ExporterOutput]]]:
        """Return for each format what calls its exporter; the Gaussians are read once."""
        shared = functools.cache(lambda: read_gaussians(self.geometry))
        parts = {name: getattr(self, name) for name in ("geometry", "material", "background")}

        def outputs(name: str) -> List[ExporterOutput]:
            exporter = find(name + SUFFIX)(vars(options_of(name, self.cfg)), **parts)
            if isinstance(exporter, FileExporter):
                exporter.shared, exporter.drawing = shared(), self.drawing
            return outputs_of(exporter)

        return {name: functools.partial(outputs, name) for name in self.cfg.formats}


def options_of(name: str, cfg: Any) -> Any:
    """Parse and check the options of one format; the bundle's ``up`` is the default of its own."""
    options, exporter = cfg.options.get(name, {}), find(name + SUFFIX)
    require_mapping(f"options.{name}", options)
    require_export(exporter)
    require_dataclass(exporter)
    if cfg.up is not None and "up" in exporter.Config.__dataclass_fields__:
        options = {"up": cfg.up, **options}
    return parse_structured(exporter.Config, options, f"options.{name}.")
