"""Base classes of parts: a typed ``Config``, a device, and ``update_step`` on everything below; and
the registry, in which a decorator enters parts under a name."""

import os
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Optional

from torch import nn

from ...core.checkpoint_file import load_module_weights
from ...core.devices import get_device
from ...core.errors import UserError, unknown
from ...core.options import parse_structured

_parts: dict[str, type] = {}


def register(name: str) -> Callable[[type], type]:
    """Return a decorator that enters a class or function under ``name``, which must be free."""

    def enter(cls: type) -> type:
        taken = _parts.get(name)
        if taken is not None and _identity(taken) != _identity(cls):
            said = f"taken by {_identity(taken)}: register {_identity(cls)} under another name"
            raise UserError(f"the name {name!r} is {said}")
        _parts[name] = cls
        return cls

    return enter


def find(name: str) -> type:
    """Return the class registered as ``name``; raise UserError, with the near ones, if none is."""
    if name not in _parts:
        raise unknown("part", name, _parts)
    return _parts[name]


def names() -> list[str]:
    """Return all registered names, sorted."""
    return sorted(_parts)


def _identity(cls: type) -> str:
    # a module that is executed again makes new class objects of the same name: still the same part
    return f"{cls.__module__}.{cls.__qualname__}"


class Updateable:
    """Something that is updated, with all its public attributes, before and after each batch."""

    def do_update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        for part in self._updateables():
            part.do_update_step(epoch, global_step, on_load_weights=on_load_weights)
        self.update_step(epoch, global_step, on_load_weights=on_load_weights)

    def do_update_step_end(self, epoch: int, global_step: int) -> None:
        for part in self._updateables():
            part.do_update_step_end(epoch, global_step)
        self.update_step_end(epoch, global_step)

    def update_step(self, epoch: int, global_step: int, on_load_weights: bool = False) -> None:
        """Prepare for the next batch; must be idempotent: several parts may share one."""

    def update_step_end(self, epoch: int, global_step: int) -> None:
        """Hook that is called after a batch."""

    def _updateables(self) -> list["Updateable"]:
        own = vars(self)
        return [
            part
            for attributes in (own, own.get("_modules", {}))
            for name, part in attributes.items()
            if isinstance(part, Updateable) and not name.startswith("_")
        ]


def run_seed() -> int:
    """Return the seed of this run, the same in all its processes; 0 if none is set."""
    return int(os.environ.get("PL_GLOBAL_SEED", 0))


def load_parameters(
    module: nn.Module, state: dict[str, Any], source: str, *, strict: bool = True
) -> None:
    """Load parameters; raise UserError if shapes differ or, with ``strict``, names."""
    try:
        module.load_state_dict(state, strict=strict)
    except RuntimeError as error:
        reasons = "; ".join(line.strip() for line in str(error).splitlines()[1:])
        said = f"({reasons}): use those of the run that wrote the file, such as its sh_degree"
        raise UserError(f"the weights of {source} don't fit these options {said}") from error


class Part(Updateable):
    """A typed configuration and a device."""

    @dataclass
    class Config:
        pass

    cfg: Config
    SECTION = ""
    """The path of the options in messages, such as "system.geometry."."""

    def __init__(self, cfg: Any = None, *args: Any, **kwargs: Any) -> None:
        super().__init__()
        self.cfg = parse_structured(self.Config, cfg, self.SECTION)
        self.device = get_device()
        self.configure(*args, **kwargs)

    def configure(self, *args: Any, **kwargs: Any) -> None:
        """Build the part from ``self.cfg`` and what the constructor got after it."""


class BaseObject(Part):
    """A part without parameters: guidance, prompt processor, prior, exporter."""


class BaseModule(Part, nn.Module):
    """A part with parameters: geometry, material, background, renderer. Of ``weights``, which is
    ``path:module``, the entries under ``module.`` are loaded after ``configure``.
    """

    @dataclass
    class Config(Part.Config):
        weights: Optional[str] = None

    cfg: Config

    def __init__(self, cfg: Any = None, *args: Any, **kwargs: Any) -> None:
        super().__init__(cfg, *args, **kwargs)
        if (source := self.cfg.weights) is not None:
            path, _, module_name = source.rpartition(":")
            if not path:
                form = "<checkpoint>:<module>, such as last.ckpt:geometry"
                raise UserError(f"weights: expected {form}, got {source!r}")
            state_dict, epoch, global_step = load_module_weights(path, module_name)
            load_parameters(self, state_dict, source)
            self.do_update_step(epoch, global_step, on_load_weights=True)
