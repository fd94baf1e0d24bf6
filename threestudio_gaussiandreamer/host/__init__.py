"""The host that parts register into: threestudio when it is importable, otherwise the built-in one.

Only this file knows which. Everything else imports these names from here; they mean the same in
both hosts.
"""

import os
from collections.abc import Callable

from ..core.distributed import rank
from ..core.errors import UserError, unknown
from ..core.schedule import C, validate_schedule
from ..core.streams import derive_seed


def _threestudio_is_importable() -> bool:
    """Tell whether ``import threestudio`` works; a folder of that name on the path that is no
    package doesn't count.

    Raises:
        UserError: threestudio is there but broken: which host is meant can't be guessed.
    """
    try:
        import threestudio
    except ModuleNotFoundError as error:
        if error.name == "threestudio":
            return False
        raise UserError(
            f"threestudio is on the Python path but can't be imported: {error}; mend it or "
            "take it off"
        ) from error
    except Exception as error:
        raise UserError(
            f"threestudio is on the Python path but can't be imported: {error!r}; mend it or "
            "take it off"
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
        """Return the seed of this run, the same in every process of it; 0 without one."""
        # threestudio gives each process the seed of the run plus its rank
        return int(os.environ.get("PL_GLOBAL_SEED", get_rank())) - get_rank()

    def names() -> list[str]:
        """Return all registered names, sorted."""
        return sorted(threestudio.__modules__)

    def find(name: str) -> type:
        """Return the class registered as ``name``.

        Raises:
            UserError: no part has that name; the message lists the near ones.
        """
        try:
            return threestudio.find(name)
        except KeyError:
            raise unknown("part", name, names()) from None

    def register(name: str) -> Callable[[type], type]:
        """Return a class decorator that enters the class under ``name``; entering the same class
        twice is harmless.
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
        """Return :func:`register`'s decorator in the built-in host, and one without effect here,
        where threestudio has its own part of that name.
        """
        return lambda cls: cls

else:
    import lightning.pytorch as pl

    from ..core.logs import debug, info, warn
    from .builtin.base import BaseModule, BaseObject, Updateable, get_device, parse_structured
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

    def run_seed() -> int:
        """Return the seed of this run, the same in every process of it; 0 without one."""
        return int(os.environ.get("PL_GLOBAL_SEED", 0))


def item_seed() -> int:
    """Return the seed of what differs between processes that train one cloud together: cameras,
    noise, backgrounds.
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
