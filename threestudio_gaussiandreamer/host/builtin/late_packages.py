"""Import Lightning without most of torchmetrics and torch's compiler, which a run doesn't use: they
take 4.5 of 7 CPU seconds of a start. Their source runs at the first use of anything but the few
names that Lightning and torch's optimisers need."""

import functools
import importlib
import logging
import sys
import threading
from importlib import metadata
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from types import ModuleType, SimpleNamespace
from typing import Any, Optional

METRICS, COMPILER = "torchmetrics", "torch._dynamo"
LOCK = threading.RLock()
EARLY = {"Metric": "metric", "MetricCollection": "collections", "": "utilities"}
"""Names of torchmetrics that Lightning uses, and the modules that define them."""


class Late(ModuleType):
    """A package whose source hasn't run yet."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(name)
        if name in EARLY and self.__name__ == METRICS:
            importlib.import_module(f"{METRICS}.utilities")
            return getattr(importlib.import_module(f"{METRICS}.{EARLY[name]}"), name)
        run(self)
        return getattr(self, name)


def run(package: Any) -> None:
    """Run a package's source, once; other threads wait for it."""
    with LOCK:
        if type(package) is not Late:
            return
        package.__class__ = ModuleType
        try:
            package.__spec__.loader.exec_module(package)
        except BaseException:
            sys.modules.pop(package.__name__, None)
            raise


def compiler() -> Any:
    """Return torch's compiler; None as long as it hasn't run."""
    found = sys.modules.get(COMPILER)
    return None if type(found) is Late else found


class Compiled(type):
    """Of a class that stands for the compiler's class of compiled modules."""

    def __instancecheck__(cls, module: Any) -> bool:
        return compiler() is not None and isinstance(module, compiler().OptimizedModule)


def disable(function: Any = None, *args: Any, **options: Any) -> Any:
    """Return a function that the compiler leaves as it is, once it has run."""
    if function is None:
        return functools.partial(disable, **options)

    @functools.cache
    def disabled(found: Any) -> Any:
        return function if found is None else found.disable(function, *args, **options)

    return functools.wraps(function)(lambda *a, **named: disabled(compiler())(*a, **named))


class Submodules:
    """Finder that runs a late package before a submodule of it is imported."""

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Optional[ModuleSpec]:
        parent, _, own = name.rpartition(".")
        package = sys.modules.get(parent)
        if type(package) is Late and own not in EARLY.values():
            run(package)
            if known := sys.modules.get(name):  # imported by the package: it mustn't run again
                spec = known.__spec__
                restore = lambda module: setattr(module, "__spec__", spec)  # noqa: E731
                loader = SimpleNamespace(create_module=lambda _: known, exec_module=restore)
                return ModuleSpec(name, loader)
        return None


def import_lightning() -> None:
    """Import ``lightning.pytorch``, as usual where a release needs more than is defined here."""
    try:
        if not {"lightning", METRICS, COMPILER} & sys.modules.keys():
            sys.meta_path.insert(0, Submodules)
            late(METRICS, __version__=metadata.version(METRICS), _logger=logging.getLogger(METRICS))
            vars(sys.modules["torch"])["_dynamo"] = late(
                COMPILER,
                OptimizedModule=Compiled("OptimizedModule", (), {}),
                disable=disable,
                graph_break=lambda *_, **__: None,
            )
        importlib.import_module("lightning.pytorch")
    except Exception:
        packages = ["lightning.", f"{METRICS}."]
        if compiler() is None:  # once it has run, it can't be imported again
            vars(sys.modules["torch"]).pop("_dynamo", None)
            packages.append(f"{COMPILER}.")
        for name in [*sys.modules]:
            if f"{name}.".startswith(tuple(packages)):
                del sys.modules[name]
        importlib.import_module("lightning.pytorch")


def late(name: str, **names: Any) -> Any:
    module = sys.modules[name] = module_from_spec(find_spec(name))
    module.__class__ = Late
    vars(module).update(names)
    return module
