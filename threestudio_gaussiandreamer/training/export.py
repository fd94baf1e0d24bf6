"""What a run leaves: the files of ``exporter_type`` of the cloud as it is, and of the cloud pruned
to ``system.prune``; and the files that show it:

==========================  =======================================================================
file in ``save/``           content
==========================  =======================================================================
it<step>-export/view.html   page for browsers: the cloud, and the initial cloud for comparison
it<step>-export/poster.png  one view with a transparent background
it<step>-test.mp4           the turntable of the test views
it<step>-test.webp          fewer frames as an animated picture, for pages that play no video
prior/gaussians.spz         the initial cloud, before training
==========================  =======================================================================
"""

import functools
import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Optional

from ..core.errors import UserError
from ..core.files import atomic_file, write_file
from ..exporters.files import RESERVED, BundleExporter, FileExporter, outputs_of, read_gaussians
from ..formats.gaussian_files import StoredCloud, read_cloud, write_cloud
from ..formats.ply import write_points
from ..formats.spz import VERSION
from ..gaussians.axes import VIEWER_UP
from ..gaussians.point_cloud import PointCloud
from ..gaussians.surface import Surface
from ..host import ExporterOutput, find, warn
from ..images import write_animation
from ..meshes.mesh import Mesh
from ..meshes.write import write_obj, write_textured_mesh
from ..prune import PruneOptions, prune_to_budget, write_report
from ..view.page import MAX_GAUSSIANS, PageOptions, Shown, decibels, page
from ..view.render import WHITE, RenderSettings, first_pose, picture
from ..view.run_files import RunFiles
from .background import FlatBackground

FIRST_CLOUD = "prior/gaussians.spz"
PAGE, POSTER = "view.html", "poster.png"
POSTER_SIZE = 512  # pixels each way
TURNTABLE_FRAMES, TURNTABLE_SIZE, TURNTABLE_SECONDS = 40, 256, 4.0
"""Of the animated picture: largest number of frames, longest side in pixels, seconds."""
SUMMARY = ("held_out/compare.png", "it*-test.*", "it*-export/*.*", "it*-export/pruned/*.*")
"""Files below the folder of results that the last message of a run names."""
CLOUDS = ("ply", "spz", "gaussians")
"""Types of exports that hold all attributes of the Gaussians."""


class GaussianSavers:
    """The ``save_<save_type>`` that our exporters name, for a system of the host."""

    def save_gaussians(
        self,
        filename: str,
        stored: StoredCloud,
        suffix: str,
        pruned_to: Optional[float] = None,
        version: int = VERSION,
    ) -> None:
        antialiased = settings_of(self).antialias
        stored = stored._replace(pruned_to=pruned_to, antialiased=antialiased)
        write_cloud(self.get_save_path(filename), stored, suffix, spz_version=version)

    save_ply = functools.partialmethod(save_gaussians, suffix=".ply")
    save_spz = functools.partialmethod(save_gaussians, suffix=".spz")

    def save_points(self, filename: str, cloud: PointCloud) -> None:
        write_points(self.get_save_path(filename), cloud)

    def save_textured_mesh(self, filename: str, mesh: Mesh, unlit: bool) -> None:
        path = self.get_save_path(filename)
        write_textured_mesh(path, mesh, unlit=unlit, name=prompt_of(self))

    def save_surface(self, filename: str, surface: Surface) -> None:
        write_obj(self.get_save_path(filename), surface)


def settings_of(system: Any) -> RenderSettings:
    """Return how a system draws."""
    bound = system.geometry.cfg.bound_colors
    return RenderSettings.of(system.renderer.cfg, bound_colors=bound)


def prompt_of(system: Any) -> str:
    """Return the prompt of a training run, else the text in the configuration."""
    prompt = getattr(system.prompt_utils, "prompt", None)
    return str(prompt or system.cfg.prompt_processor.get("prompt") or "")


# -- exports ---------------------------------------------------------------------------------------


def export(system: Any) -> None:
    """Write exports, page and pruned cloud; raise the first error after all others are written."""
    folder = f"it{system.true_global_step}-export"
    calls = writers(system, system.geometry, folder)
    calls |= {"the page": lambda: write_pages(system, folder)}
    _call_each(calls | {"system.prune": lambda: export_pruned(system, f"{folder}/pruned")})


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


def writers(
    system: Any, geometry: Any, folder: str, pruned_to: Optional[float] = None
) -> dict[str, Callable[[], None]]:
    """Map the exporter's formats to what writes them to ``folder``; ``pruned_to`` (dB) is noted."""
    parts = {"geometry": geometry, "material": system.material, "background": system.background}
    exporter = find(system.cfg.exporter_type)(system.cfg.exporter, **parts)
    if isinstance(exporter, (FileExporter, BundleExporter)):
        drawn = settings_of(system)
        exporter.drawing = {"eps2d": drawn.eps2d, "antialias": drawn.antialias}
    single = {system.cfg.exporter_type: lambda: outputs_of(exporter)}
    formats = exporter.by_format() if isinstance(exporter, BundleExporter) else single
    written: set[str] = set()

    def write(outputs: Callable[[], list[ExporterOutput]]) -> None:
        for out in outputs():
            # names that differ only in case are the same on some file systems
            name = os.path.normpath(out.save_name).casefold()
            if name in written or Path(name).parts[:1] in [(reserved,) for reserved in RESERVED]:
                said = "another file of the export has this name"
                raise UserError(f"save_name {out.save_name!r}: {said}")
            written.add(name)
            noted = {"pruned_to": pruned_to} if out.save_type in CLOUDS else {}
            save = getattr(system, f"save_{out.save_type}")
            save(f"{folder}/{out.save_name}", **{**noted, **out.params})

    return {name: functools.partial(write, outputs) for name, outputs in formats.items()}


def export_pruned(system: Any, folder: str) -> None:
    """Write the exports and the report of the cloud pruned to ``system.prune``, if it is given."""
    options, drawn = PruneOptions(**vars(system.cfg.prune)), settings_of(system)
    if not options.asked_for:
        return
    if options.eps2d is None:
        options.eps2d = drawn.eps2d
    if options.antialias is None:
        options.antialias = drawn.antialias
    # a budget in bytes is that of the SPZ file where it is exported
    cfg = system.cfg
    spz = cfg.exporter_type == "spz-exporter" or "spz" in cfg.exporter.get("formats", ())
    suffix = ".spz" if spz else ".ply"
    cloud = StoredCloud(read_gaussians(system.geometry))
    result = prune_to_budget(cloud, options, suffix, "system.prune.")
    geometry = find(cfg.geometry_type)(cfg.geometry)
    geometry.set_arrays(**result.after.gaussians._asdict())
    _call_each(writers(system, geometry, folder, result.after.pruned_to))
    write_report(system.get_save_path(f"{folder}/report"), result, suffix, options)


# -- pages and turntables --------------------------------------------------------------------------


def save_first_cloud(system: Any) -> None:
    """Keep the cloud that training starts with, which pages show beside the result."""
    if system.cfg.pages and system.trainer.is_global_zero:
        first = StoredCloud(read_gaussians(system.geometry))
        write_cloud(system.get_save_path(FIRST_CLOUD), first, ".spz")


def write_pages(system: Any, folder: str) -> None:
    """Write the page and the poster, unless ``system.pages`` is off or a page can't show it."""
    if not system.cfg.pages:
        return
    run, settings = RunFiles(Path(system.get_save_dir()).parent), settings_of(system)
    color, background = WHITE, system.background
    if FlatBackground.is_flat(background):
        learned = background.cfg.mode == "learned"
        color = tuple(background.color(1)[0].tolist() if learned else background.cfg.color)
    options = PageOptions(
        title=prompt_of(system) or run.folder.name,
        name="gaussians",
        settings=settings,
        background=color,
        keep_background=run.background_is_given,
    )
    cloud = StoredCloud(read_gaussians(system.geometry)).in_axes(VIEWER_UP)
    cloud = cloud._replace(antialiased=settings.antialias)
    result = Shown(cloud, "result", decibels(run.psnr("result", system.true_global_step)))
    try:
        content = page(result, options, _first_cloud(run))
    except UserError as error:
        warn(f"no {PAGE} is written: {error}")
        return
    write_file(system.get_save_path(f"{folder}/{PAGE}"), content)
    with atomic_file(system.get_save_path(f"{folder}/{POSTER}"), durable=False) as file:
        picture(cloud, settings, first_pose(cloud), POSTER_SIZE).save(file, "png")


def _first_cloud(run: RunFiles) -> Optional[Shown]:
    """Return the cloud that training has started with, if it is there and a page can show it."""
    path = run.save / FIRST_CLOUD
    if not path.is_file():
        return None
    cloud = read_cloud(str(path))
    shown = 0 < len(cloud.gaussians.means) <= MAX_GAUSSIANS
    return Shown(cloud, "prior", decibels(run.psnr("prior"))) if shown else None


def turntable_name(system: Any) -> str:
    """Return the name of the folder of test pictures, and of the video without its suffix."""
    return f"it{system.true_global_step}-test"


def discard_turntable(system: Any) -> None:
    """Remove the pictures of an earlier test of the same step, which may have had more views."""
    for path in Path(system.get_save_dir(), turntable_name(system)).glob("*.png"):
        path.unlink(missing_ok=True)  # another test may remove them too


def write_turntable(system: Any) -> None:
    """Write the test pictures as a video, or warn, since the exports follow; and some as WebP."""
    name = turntable_name(system)
    options = {"save_format": "mp4", "fps": 30, "name": "test", "step": system.true_global_step}
    try:
        system.save_img_sequence(name, name, r"(\d+)\.png", **options)
    except UserError as error:
        warn(str(error))
    folder = Path(system.get_save_dir(), name)
    # every n-th frame, with n rounded up, so that at most TURNTABLE_FRAMES are left
    frames = sorted(folder.glob("*.png"), key=lambda path: int(path.stem))
    chosen = frames[:: -(-len(frames) // TURNTABLE_FRAMES) or 1]
    if chosen and system.cfg.pages:
        write_animation(folder.with_suffix(".webp"), chosen, TURNTABLE_SIZE, TURNTABLE_SECONDS)
