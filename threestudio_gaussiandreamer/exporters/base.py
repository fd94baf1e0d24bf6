"""What every exporter starts from.

An exporter is one file: a subclass of the host's ``Exporter`` registered as ``<format>-exporter``,
whose call returns a list of ``ExporterOutput(save_name, save_type, params)``; the system writes
each with its ``save_<save_type>(name, **params)``."""

import os
from dataclasses import dataclass

from ..core.errors import UserError
from ..gaussians.gaussians import Gaussians
from ..host import BaseGeometry, Exporter


NAME_BYTES = 255
"""The longest name of a file on common file systems."""


class FileExporter(Exporter):
    """An exporter of one file; its options are checked before anything else, also by threestudio's
    own host, which doesn't.
    """

    @dataclass
    class Config(Exporter.Config):
        save_name: str = ""

        @staticmethod
        def check(cfg: "FileExporter.Config") -> None:
            """Raises UserError for a name that isn't that of a file."""
            require_file_name(cfg.save_name)

    cfg: Config

    def configure(self, geometry: BaseGeometry, *args: object, **kwargs: object) -> None:
        self.Config.check(self.cfg)
        super().configure(geometry, *args, **kwargs)


RESERVED = ("pruned", "report.json", "report.png")
"""What a run itself writes into the folder of its exports."""


def require_file_name(name: str) -> None:
    """Raise UserError unless ``name`` is that of a file inside the export folder."""
    if not name or name != os.path.basename(name) or name in (os.curdir, os.pardir):
        raise UserError(f"save_name: expected the name of a file, without folders, got {name!r}")
    if "\0" in name or len(name.encode(errors="surrogateescape")) > NAME_BYTES:
        raise UserError(
            f"save_name: expected at most {NAME_BYTES} bytes and no NUL, got {name[:80]!r}"
        )
    if name.casefold() in RESERVED:
        raise UserError(f"save_name: {name!r} is a name that a run uses itself; choose another one")


def gaussian_arrays(geometry: BaseGeometry) -> Gaussians:
    """The parameters of a geometry as float32 arrays on the CPU."""
    return Gaussians.of(geometry).arrays()
