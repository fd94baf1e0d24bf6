"""The host that parts register into: threestudio when it is importable, otherwise the built-in one;
all other modules import these names from here, with the same meaning in both hosts."""

import dataclasses
import os
from collections.abc import Callable
from typing import Any

from ..core.distributed import rank
from ..core.errors import UserError, unknown
from ..core.options import parse_structured
from ..core.schedule import C, validate_schedule
from ..core.streams import derive_seed


def _threestudio_is_importable() -> bool:
    """Return whether ``import threestudio`` gives the package, and not just a folder of that name;
    raise UserError if it is installed, but importing it fails: the intended host is ambiguous.
    """
    try:
        import threestudio
    except Exception as error:
        if isinstance(error, ModuleNotFoundError) and error.name == "threestudio":
            return False
        said = f"can't be imported: {error}; fix it or remove it"
        raise UserError(f"threestudio is on the Python path but {said}") from error
    return hasattr(threestudio, "register")


if _threestudio_is_importable():
    import pytorch_lightning as pl
    import threestudio
    from omegaconf import OmegaConf
    from threestudio import debug, info, warn
    from threestudio.models.background import base as backgrounds
    from threestudio.models.exporters import base as exporters
    from threestudio.models.exporters.base import ExporterOutput
    from threestudio.models.geometry import base as geometries
    from threestudio.models.materials import base as materials
    from threestudio.models.renderers import base as renderers
    from threestudio.systems import base as systems
    from threestudio.utils import base as parts
    from threestudio.utils.base import Updateable
    from threestudio.utils.misc import get_device, get_rank

    NAME = "threestudio"
    IDENTITY = ("__module__", "__qualname__")

    class Checked:
        """Puts the checked options in the place of those that threestudio parses."""

        SECTION = ""

        def __init__(self, cfg: Any = None, *args: Any, **kwargs: Any) -> None:
            given = {} if cfg is None else cfg
            options = self.__dict__["_options"] = parse_structured(self.Config, given, self.SECTION)
            # threestudio parses neither nested options nor those of earlier versions
            flat = [key for key, v in vars(options).items() if not dataclasses.is_dataclass(v)]
            given = {name: given[name] for name in flat if name in given}
            super().__init__(given, *args, **kwargs)

        @property
        def cfg(self) -> Any:
            return self._options

        @cfg.setter
        def cfg(self, parsed: Any) -> None:
            """Ignore what threestudio has parsed."""

    class CheckedSystem(Checked):
        """Does with plain options what threestudio's systems do with OmegaConf's."""

        def C(self, value: Any) -> float:
            return C(value, self.true_current_epoch, self.true_global_step)

        def configure_optimizers(self) -> Any:
            options = self._options
            given = {name: getattr(options, name) for name in ("optimizer", "scheduler")}
            read = {name: OmegaConf.create(value) for name, value in given.items() if value}
            self.__dict__["_options"] = dataclasses.replace(options, **read)
            try:
                return super().configure_optimizers()
            finally:
                self.__dict__["_options"] = options

    def _checked(host: type, kind: type = Checked) -> type:
        """Derive a class with checked options from a base class of threestudio."""
        return type(host.__name__, (kind, host), {"HOST": host})

    BaseBackground = _checked(backgrounds.BaseBackground)
    BaseGeometry = _checked(geometries.BaseGeometry)
    BaseLift3DSystem = _checked(systems.BaseLift3DSystem, CheckedSystem)
    BaseMaterial = _checked(materials.BaseMaterial)
    BaseModule = _checked(parts.BaseModule)
    BaseObject = _checked(parts.BaseObject)
    BaseSystem = _checked(systems.BaseSystem, CheckedSystem)
    Exporter = _checked(exporters.Exporter)
    Rasterizer = _checked(renderers.Rasterizer)

    def run_seed() -> int:
        """Return the seed of this run, the same in all its processes; 0 if none is set."""
        # threestudio seeds each process with the run's seed plus the rank of the process
        return int(os.environ.get("PL_GLOBAL_SEED", get_rank())) - get_rank()

    def names() -> list[str]:
        """Return all registered names, sorted."""
        return sorted(threestudio.__modules__)

    def find(name: str) -> type:
        """Return the class registered as ``name``; raise UserError, with near ones, if none is."""
        try:
            return threestudio.find(name)
        except KeyError:
            raise unknown("part", name, names()) from None

    def register(name: str) -> Callable[[type], type]:
        """Return a decorator that registers a class as ``name``; again the same one is harmless."""

        def enter(cls: type) -> type:
            taken = threestudio.__modules__.get(name)
            is_same = taken and all(getattr(taken, n) == getattr(cls, n) for n in IDENTITY)
            return cls if is_same else threestudio.register(name)(cls)

        return enter

    def register_builtin(name: str) -> Callable[[type], type]:
        """Return a decorator without effect, since threestudio has its own part of this name."""
        return lambda cls: cls

else:
    from .builtin.late_packages import import_lightning

    import_lightning()

    import lightning.pytorch as pl

    from ..core.devices import get_device
    from ..core.logs import debug, info, warn
    from .builtin.base import (
        BaseModule,
        BaseObject,
        Updateable,
        find,
        names,
        register,
        run_seed,
    )
    from .builtin.models import (
        BaseBackground,
        BaseGeometry,
        BaseMaterial,
        Exporter,
        ExporterOutput,
        Rasterizer,
    )
    from .builtin.system import BaseLift3DSystem, BaseSystem

    NAME = "builtin"
    register_builtin = register


def item_seed() -> int:
    """Return the seed for what draws from torch's global generators, which differs between the
    processes that train one cloud together.
    """
    return run_seed() if rank() == 0 else derive_seed(run_seed(), "rank", rank())
