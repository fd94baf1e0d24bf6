"""Exports of a run: the files of ``exporter_type`` of the cloud as it is, and of the cloud pruned
to ``system.prune``.
"""

import functools
import inspect
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError, unknown
from ..exporters.files import (
    RESERVED,
    BundleExporter,
    Drawing,
    FileExporter,
    outputs_of,
    read_gaussians,
)
from ..formats.gaussian_files import StoredCloud, write_cloud
from ..formats.ply import write_points
from ..formats.spz import VERSION
from ..gaussians.point_cloud import PointCloud
from ..gaussians.surface import Surface
from ..host import ExporterOutput, find, warn
from ..meshes.mesh import Mesh
from ..meshes.write import write_obj, write_textured_mesh
from ..prune import PruneOptions, prune_to_budget, write_report
from ..view.render import RenderSettings
from .pages import prompt_of, write_pages
from .renderer import SplattingRenderer

SUMMARY = ("held_out/compare.png", "it*-test.*", "it*-export/*.*", "it*-export/pruned/*.*")
"""Files below the folder of results that the last message of a run names."""


Spent = Optional[float]
"""PSNR in dB that a cloud has been pruned to."""
CLOUDS = ("ply", "spz", "gaussians")
"""Types of exports that hold all attributes of the Gaussians."""


class GaussianSavers:
    """The ``save_<save_type>`` that our exporters name, for a system of the host; each writes
    below the system's folder and returns the path.
    """

    def save_ply(self, filename: str, stored: StoredCloud, pruned_to: Spent = None) -> str:
        return self.save_gaussians(filename, stored, ".ply", pruned_to)

    def save_spz(
        self, filename: str, stored: StoredCloud, pruned_to: Spent = None, version: int = VERSION
    ) -> str:
        return self.save_gaussians(filename, stored, ".spz", pruned_to, spz_version=version)

    def save_gaussians(
        self,
        filename: str,
        stored: StoredCloud,
        suffix: str,
        pruned_to: Spent = None,
        **options: Any,
    ) -> str:
        path = self.get_save_path(filename)
        stored = stored._replace(pruned_to=pruned_to, antialiased=drawing(self).antialias)
        write_cloud(path, stored, suffix, **options)
        return path

    def save_points(self, filename: str, cloud: PointCloud) -> str:
        path = self.get_save_path(filename)
        write_points(path, cloud)
        return path

    def save_textured_mesh(self, filename: str, mesh: Mesh, unlit: bool) -> str:
        path = self.get_save_path(filename)
        write_textured_mesh(path, mesh, unlit=unlit, name=prompt_of(self))
        return path

    def save_surface(self, filename: str, surface: Surface) -> str:
        path = self.get_save_path(filename)
        write_obj(path, surface)
        return path


def export(system: Any) -> None:
    """Write the files of the exporter, the page, and the pruned cloud; a training run ends with it,
    and so does ``--export``, after the video.

    Raises:
        Exception: the first error of one of these, after all others are written.
    """
    folder = export_folder(system)
    _call_each(
        {
            **writers(system, system.geometry, folder),
            "the page": lambda: write_pages(system, folder),
            "system.prune": lambda: export_pruned(system),
        }
    )


def _call_each(calls: Mapping[str, Callable[[], Any]]) -> None:
    """Make all calls; name those that fail, and then raise the first error."""
    first: Optional[Exception] = None
    for name, call in calls.items():
        try:
            call()
        except Exception as error:
            if first is None:
                first = error
                warn(f"{name} failed; the other files are written before its error is shown")
            else:
                warn(f"{name} failed: {type(error).__name__}: {error}")
    if first is not None:
        raise first


def export_folder(system: Any) -> str:
    """Name the folder of this step's exports, below the folder of results."""
    return f"it{system.true_global_step}-export"


def writers(
    system: Any, geometry: Any, folder: str, pruned_to: Optional[float] = None
) -> dict[str, Callable[[], None]]:
    """Return a function for each format of the exporter of ``system`` that writes its files of a
    geometry.

    Args:
        folder: below the system's folder of results.
        pruned_to: PSNR in dB, noted in files of Gaussians.
    """
    parts = {"geometry": geometry, "material": system.material, "background": system.background}
    exporter = find(system.cfg.exporter_type)(system.cfg.exporter, **parts)
    if isinstance(exporter, (FileExporter, BundleExporter)):
        exporter.drawing = drawing(system)
    single = {system.cfg.exporter_type: lambda: outputs_of(exporter)}
    formats = exporter.by_format() if isinstance(exporter, BundleExporter) else single
    names: set[str] = set()

    def write(outputs: Callable[[], list[ExporterOutput]]) -> None:
        for out in outputs():
            require_new_name(out.save_name, names)
            noted = {"pruned_to": pruned_to} if out.save_type in CLOUDS else {}
            save(system, out, f"{folder}/{out.save_name}", noted)

    return {name: functools.partial(write, outputs) for name, outputs in formats.items()}


def require_new_name(name: str, names: set[str]) -> None:
    """Add the name of a file to those of an export.

    Raises:
        UserError: there is a file of this name, or a run writes one itself. Names that differ only
            in case count as the same.
    """
    key = os.path.normpath(name).casefold()
    if key in names or Path(key).parts[:1] in [(reserved,) for reserved in RESERVED]:
        raise UserError(f"save_name {name!r}: another file of the export has this name")
    names.add(key)


def save(system: Any, out: ExporterOutput, path: str, noted: Mapping[str, Any]) -> None:
    """Write one output of an exporter.

    Raises:
        UserError: the system can't save its type, or the type has other params.
    """
    write, params = getattr(system, f"save_{out.save_type}", None), {**noted, **out.params}
    if write is None:
        known = [name.removeprefix("save_") for name in dir(system) if name.startswith("save_")]
        raise unknown("save_type of an exporter", out.save_type, known)
    try:
        inspect.signature(write).bind(path, **params)
    except TypeError as error:
        raise UserError(
            f"params of {out.save_name}: {error}; save_{out.save_type} takes "
            f"{inspect.signature(write)}"
        ) from error
    write(path, **params)


def export_pruned(system: Any) -> None:
    """Write the same files of the cloud pruned to ``system.prune``, if it is given, into the
    folder ``pruned`` beside them, with the prune command's report.
    """
    options = prune_options(system)
    if not options.asked_for:
        return
    folder, suffix = f"{export_folder(system)}/pruned", _suffix(system.cfg)
    result = prune_to_budget(
        StoredCloud(read_gaussians(system.geometry)), options, suffix, "system.prune."
    )
    geometry = find(system.cfg.geometry_type)(system.cfg.geometry)
    geometry.set_arrays(**result.after.gaussians._asdict())
    _call_each(writers(system, geometry, folder, result.after.pruned_to))
    write_report(system.get_save_path(f"{folder}/report"), result, suffix, options)


def prune_options(system: Any) -> PruneOptions:
    """Return ``system.prune``, with the dilation and antialiasing of our renderer unless given."""
    options, drawn = PruneOptions(**vars(system.cfg.prune)), drawing(system)
    if options.eps2d is None:
        options.eps2d = drawn.eps2d
    if options.antialias is None:
        options.antialias = drawn.antialias
    return options


def drawing(system: Any) -> Drawing:
    """Return how a system draws; with another renderer than ours, as most viewers do."""
    renderer = getattr(system, "renderer", None)
    if not isinstance(renderer, SplattingRenderer):
        return Drawing()
    settings = RenderSettings.of(renderer.cfg, bound_colors=True)
    return Drawing(settings.eps2d, settings.antialias)


def _suffix(cfg: Any) -> str:
    """Return the format that a budget in bytes holds for: SPZ where it is exported."""
    spz = cfg.exporter_type == "spz-exporter" or "spz" in cfg.exporter.get("formats", ())
    return ".spz" if spz else ".ply"


def exported_files(folder: Path) -> list[str]:
    """List the results below ``folder`` that a user wants to open."""
    return [str(path) for pattern in SUMMARY for path in sorted(folder.glob(pattern))]
