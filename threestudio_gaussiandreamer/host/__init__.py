"""The host that parts register into: threestudio when it is importable, otherwise the built-in one.

This is the only module that selects the host. All others import these names from here, with the
same meaning in both hosts.
"""

import os
from collections.abc import Callable

from ..core.distributed import rank
from ..core.errors import UserError, unknown
from ..core.schedule import C, validate_schedule
from ..core.streams import derive_seed


def _threestudio_is_importable() -> bool:
    """Return whether ``import threestudio`` gives the package, and not just a folder of that name.

    Raises:
        UserError: threestudio is installed, but importing it fails; the intended host is ambiguous.
    """
    try:
        import threestudio
    except ModuleNotFoundError as error:
        if error.name == "threestudio":
            return False
        raise UserError(
            f"threestudio is on the Python path but can't be imported: {error}; fix it or remove it"
        ) from error
    except Exception as error:
        raise UserError(
            f"threestudio is on the Python path but can't be imported: {error!r}; fix it or "
            "remove it"
        ) from error
    return hasattr(threestudio, "register")


if _threestudio_is_importable():
    import pytorch_lightning as pl
    import threestudio
    from threestudio import debug, info, warn
    from threestudio.models.background.base import BaseBackground
    from threestudio.models.exporters.base import Exporter, ExporterOutput
    from threestudio.models.geometry.base import BaseGeometry
    from threestudio.models.materials.base import BaseMaterial
    from threestudio.models.renderers.base import Rasterizer
    from threestudio.systems.base import BaseLift3DSystem, BaseSystem
    from threestudio.utils.base import BaseModule, BaseObject, Updateable
    from threestudio.utils.config import parse_structured
    from threestudio.utils.misc import get_device, get_rank

    NAME = "threestudio"

    def run_seed() -> int:
        """Return the seed of this run, the same in all its processes; 0 if none is set."""
        # threestudio seeds each process with the run's seed plus the rank of the process
        return int(os.environ.get("PL_GLOBAL_SEED", get_rank())) - get_rank()

    def names() -> list[str]:
        """Return all registered names, sorted."""
        return sorted(threestudio.__modules__)

    def find(name: str) -> type:
        """Return the class registered as ``name``.

        Raises:
            UserError: no part has that name; the message lists similar ones.
        """
        try:
            return threestudio.find(name)
        except KeyError:
            raise unknown("part", name, names()) from None

    def register(name: str) -> Callable[[type], type]:
        """Return a class decorator that registers the class as ``name``; registering the same class
        again has no effect.
        """

        def enter(cls: type) -> type:
            taken = threestudio.__modules__.get(name)
            if taken is not None and (taken.__module__, taken.__qualname__) == (
                cls.__module__,
                cls.__qualname__,
            ):
                return cls
            return threestudio.register(name)(cls)

        return enter

    def register_builtin(name: str) -> Callable[[type], type]:
        """Return a class decorator that has no effect, since threestudio has its own part of this
        name. In the built-in host it is :func:`register`.
        """
        return lambda cls: cls

else:
    from .builtin.late_packages import import_lightning

    import_lightning()

    import lightning.pytorch as pl

    from ..core.devices import get_device
    from ..core.logs import debug, info, warn
    from .builtin.base import BaseModule, BaseObject, Updateable, parse_structured, run_seed
    from .builtin.models import (
        BaseBackground,
        BaseGeometry,
        BaseMaterial,
        Exporter,
        ExporterOutput,
        Rasterizer,
    )
    from .builtin.registry import find, names, register
    from .builtin.system import BaseLift3DSystem, BaseSystem

    NAME = "builtin"
    register_builtin = register


def item_seed() -> int:
    """Return the seed for what draws from torch's global generators, which differs between the
    processes that train one cloud together.
    """
    return run_seed() if rank() == 0 else derive_seed(run_seed(), "rank", rank())


__all__ = [
    "NAME",
    "BaseBackground",
    "BaseGeometry",
    "BaseLift3DSystem",
    "BaseMaterial",
    "BaseModule",
    "BaseObject",
    "BaseSystem",
    "C",
    "Exporter",
    "ExporterOutput",
    "Rasterizer",
    "Updateable",
    "debug",
    "find",
    "get_device",
    "info",
    "item_seed",
    "names",
    "parse_structured",
    "pl",
    "register",
    "register_builtin",
    "run_seed",
    "validate_schedule",
    "warn",
]
