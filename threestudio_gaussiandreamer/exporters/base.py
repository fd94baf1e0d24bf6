"""What every exporter starts from.

An exporter is one file: a subclass of the host's ``Exporter`` registered as ``<format>-exporter``,
whose call returns a list of ``ExporterOutput(save_name, save_type, params)``; the system writes
each with its ``save_<save_type>(name, **params)``."""

import os
from dataclasses import dataclass

from ..core.errors import UserError
from ..gaussians.gaussians import Gaussians
from ..host import BaseGeometry, Exporter


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


def require_file_name(name: str) -> None:
    """Raise UserError unless ``name`` is that of a file inside the export folder."""
    if not name or name != os.path.basename(name) or name in (os.curdir, os.pardir):
        raise UserError(f"save_name: expected the name of a file, without folders, got {name!r}")


def gaussian_arrays(geometry: BaseGeometry) -> Gaussians:
    """The parameters of a geometry as float32 arrays on the CPU."""
    return Gaussians.of(geometry).arrays()
