"""What all exporters share.

An exporter is one file: a subclass of the host's ``Exporter`` registered as ``<format>-exporter``,
whose call returns a list of ``ExporterOutput(save_name, save_type, params)``; the system writes
each with its ``save_<save_type>(name, **params)``."""

import os
from dataclasses import dataclass, field
from typing import Optional

from ..core.errors import UserError
from ..core.options import check_options, one_of, rule
from ..gaussians.axes import AXES
from ..gaussians.gaussians import Gaussians, finite
from ..host import BaseGeometry, Exporter

NAME_BYTES = 255
"""The longest name of a file on common file systems."""


RESERVED = ("pruned", "report.json", "report.png")
"""What a run itself writes into the folder of its exports."""


def require_file_name(option: str, name: str) -> None:
    """Raise UserError unless ``name`` is that of a file inside the export folder.

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
"""The axis of a file that is up."""


class FileExporter(Exporter):
    """An exporter of one file."""

    @dataclass
    class Config(Exporter.Config):
        save_name: str = field(default="", metadata=SAVE_NAME)

    cfg: Config
    shared: Optional[Gaussians] = None
    """The Gaussians that a bundle has read for all its formats."""

    def configure(self, geometry: BaseGeometry, *args: object, **kwargs: object) -> None:
        check_options(self.Config, self.cfg)
        super().configure(geometry, *args, **kwargs)

    def gaussians(self) -> Gaussians:
        """Return what is to be exported, in the world's axes; every value is finite."""
        return read_gaussians(self.geometry) if self.shared is None else self.shared


def read_gaussians(geometry: BaseGeometry) -> Gaussians:
    """Read the Gaussians of a geometry as finite float32 arrays; those that can't be drawn are left
    out, with a warning.
    """
    return finite(Gaussians.of(geometry).arrays(), "export")
