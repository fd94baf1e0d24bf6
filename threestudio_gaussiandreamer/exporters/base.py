"""The base class of exporters.

An exporter is a subclass of the host's ``Exporter``, registered as ``<format>-exporter``; most are
rows of the table of ``exporters/files.py``. A call returns a list of ``ExporterOutput(save_name,
save_type, params)``, and the system writes each with its method ``save_<save_type>(name,
**params)``.

===========  ==================================================================================
option       meaning (all exporters that write one file have these)
===========  ==================================================================================
save_name    name of the file in the export folder
save_video   also render the turntable
===========  ==================================================================================
"""

import os
from dataclasses import dataclass, field
from typing import NamedTuple, Optional

from ..core.errors import UserError
from ..core.methods import find_method, require_method
from ..core.options import check_options, one_of, rule
from ..gaussians.axes import AXES
from ..gaussians.densify import LOG_SCALE_RANGE
from ..gaussians.gaussians import Gaussians, finite
from ..gaussians.views import EPS2D
from ..host import BaseGeometry, Exporter, ExporterOutput

NAME_BYTES = 255
"""The longest file name on common file systems, bytes."""


RESERVED = ("pruned", "report.json", "report.png", "view.html", "poster.png")
"""Names of other files that a run writes into the export folder."""


def require_file_name(option: str, name: str) -> None:
    """Raise UserError unless ``name`` is a valid name of a file directly in the export folder.

    Args:
        option: the path of the option, for the message.
    """
    if not name or name != os.path.basename(name) or name in (os.curdir, os.pardir):
        raise UserError(f"{option}: expected the name of a file, without folders, got {name!r}")
    if "\0" in name or len(name.encode(errors="surrogateescape")) > NAME_BYTES:
        raise UserError(
            f"{option}: expected at most {NAME_BYTES} bytes and no NUL, got {name[:80]!r}"
        )
    if name.casefold() in RESERVED:
        raise UserError(f"{option}: {name!r} is a name that a run uses itself; choose another one")


SAVE_NAME = rule(require_file_name)
UP = one_of(AXES)
"""The rule for the option ``up``, the axis of the file that points up."""


class Drawing(NamedTuple):
    """The options of a run's renderer that its exports need."""

    eps2d: float = EPS2D
    """Screen-space dilation in square pixels of the final image."""
    antialias: bool = False


class FileExporter(Exporter):
    """Base class of exporters that write one file."""

    @dataclass
    class Config(Exporter.Config):
        save_name: str = field(default="", metadata=SAVE_NAME)

    cfg: Config
    shared: Optional[Gaussians] = None
    """Set by the bundle exporter, which reads the Gaussians once for all formats."""
    drawing: Drawing = Drawing()
    """Set by the system before it calls the exporter."""

    def configure(self, geometry: BaseGeometry, *args: object, **kwargs: object) -> None:
        check_options(self.Config, self.cfg)
        super().configure(geometry, *args, **kwargs)

    def gaussians(self) -> Gaussians:
        """Return the Gaussians to export, in the world's axes; all values are finite."""
        return read_gaussians(self.geometry) if self.shared is None else self.shared


def require_export(exporter: type) -> None:
    """Raise UserError for a class of exporters that can't be called."""
    if not isinstance(exporter, type):
        raise UserError(f"an exporter is a {type(exporter).__name__}; register a class")
    # the host's only raises an error
    if find_method(exporter, "__call__") is find_method(Exporter, "__call__"):
        raise UserError(f"{exporter.__name__} has no __call__(), which returns the files to write")
    require_method(exporter, "__call__")


def outputs_of(exporter: Exporter) -> list[ExporterOutput]:
    """Call an exporter.

    Raises:
        UserError: it returns something else than a list of ExporterOutput.
    """
    found = exporter()
    is_list = isinstance(found, (list, tuple))
    wrong = [x for x in (found if is_list else [found]) if not isinstance(x, ExporterOutput)]
    if wrong:
        raise UserError(
            f"{type(exporter).__name__} returned {'entries of type ' if is_list else ''}"
            f"{type(wrong[0]).__name__}; expected a list of ExporterOutput"
        )
    return list(found)


def read_gaussians(geometry: BaseGeometry) -> Gaussians:
    """Read the Gaussians of a geometry as float32 arrays. Those with values that aren't finite are
    skipped with a warning.
    """
    found = finite(Gaussians.of(geometry).arrays(), "export")
    return found._replace(log_scales=found.log_scales.clip(*LOG_SCALE_RANGE))  # as they are drawn
