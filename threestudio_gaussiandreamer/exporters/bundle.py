"""``gaussiandreamer-exporter``: several formats in one export.

============  ======================================================================================
option        meaning
============  ======================================================================================
formats       names of registered exporters without their ``-exporter``: ``ply``, ``spz``,
              ``compressed-ply``, ``sog``, ``glb``, ``usda``, ``points``, ``surface``
options       options of single formats, such as ``{ply: {pad_sh_degree: 3}}``
up            the up axis in all formats that have this option (``ply``, ``surface``): ``z`` for
              this package's world; by default the axis that viewers of each format expect
save_video    also render the turntable
============  ======================================================================================
"""

import functools
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Dict, List, Optional

from ..core.errors import UserError
from ..core.methods import require_dataclass
from ..core.options import check_options, each, one_of
from ..host import (
    BaseBackground,
    BaseGeometry,
    BaseMaterial,
    Exporter,
    ExporterOutput,
    find,
    names,
    parse_structured,
    register,
)
from .base import UP, Drawing, FileExporter, outputs_of, read_gaussians, require_export

SUFFIX = "-exporter"


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
            """Check formats and their options.

            Raises:
                UserError: options of a format are invalid, there are options of a format that isn't
                    in ``formats``, or two formats write the same file.
            """
            for name in cfg.options:
                if name not in cfg.formats:
                    raise UserError(
                        f"options.{name}: {name} isn't in formats ({', '.join(cfg.formats)}), so "
                        "its options have no effect"
                    )
            _require_own_files(
                (name, _checked(name, options_of(name, cfg))) for name in cfg.formats
            )

    cfg: Config

    def configure(
        self,
        geometry: BaseGeometry,
        material: Optional[BaseMaterial],
        background: Optional[BaseBackground],
    ) -> None:
        super().configure(geometry, material, background)
        check_options(self.Config, self.cfg)
        self.parts = dict(geometry=geometry, material=material, background=background)
        self.drawing = Drawing()

    def __call__(self) -> List[ExporterOutput]:
        return [output for outputs in self.by_format().values() for output in outputs()]

    def by_format(self) -> Dict[str, Callable[[], List[ExporterOutput]]]:
        """Return a function for each format that builds and calls its exporter, so that one that
        fails leaves the others. The Gaussians are read once for all of them.
        """
        shared = functools.cache(lambda: read_gaussians(self.geometry))

        def outputs(name: str) -> List[ExporterOutput]:
            exporter = find(name + SUFFIX)(options_of(name, self.cfg), **self.parts)
            if isinstance(exporter, FileExporter):
                exporter.shared, exporter.drawing = shared(), self.drawing
            return outputs_of(exporter)

        return {name: functools.partial(outputs, name) for name in self.cfg.formats}


def options_of(name: str, cfg: Any) -> Any:
    """Return the options of one format, with the bundle's ``up`` as default if the format has that
    option.
    """
    options, known = cfg.options.get(name, {}), find(name + SUFFIX).Config.__dataclass_fields__
    if cfg.up is None or "up" not in known or not isinstance(options, Mapping):
        return options
    return {"up": cfg.up, **options}


def _checked(name: str, options: Any) -> Any:
    """Parse and check the options of one format."""
    if not isinstance(options, Mapping):
        raise UserError(f"options.{name}: expected keys and values, got {options!r}")
    exporter = find(name + SUFFIX)
    require_export(exporter)
    require_dataclass(exporter)
    config_class = exporter.Config
    try:
        cfg = parse_structured(config_class, options)
    except UserError as error:
        raise UserError(f"options.{name}: {error}") from error
    check_options(config_class, cfg, f"options.{name}.")
    return cfg


def _require_own_files(formats: Iterable[tuple[str, Any]]) -> None:
    """Raise UserError if two formats write the same file. Names that differ only in case count as
    the same, as on some file systems.
    """
    writers: dict[str, str] = {}
    for name, cfg in formats:
        file = getattr(cfg, "save_name", None)
        if file is None:
            continue
        other = writers.setdefault(file.casefold(), name)
        if other != name:
            raise UserError(
                f"options.{name}.save_name: {file!r} is the file of the format {other}; choose "
                "another name"
            )
