"""Packages that Lightning and torch's optimisers import, and that a run doesn't use: most of
torchmetrics, which imports ``scipy.signal`` and ``transformers``; its plots, which import
``matplotlib``; and torch's compiler. Together they take more time than all else that a run imports.

They are put into ``sys.modules`` without being run. They run at the first use of anything but the
few names that Lightning and the optimisers need, which are defined here; from then on the package
is as if it had been imported."""

import functools
import importlib
import logging
import sys
import threading
from collections.abc import Callable, Sequence
from importlib import metadata
from importlib.machinery import ModuleSpec, PathFinder
from importlib.util import find_spec, module_from_spec
from pathlib import Path
from types import ModuleType
from typing import Any, Optional

import torch

PLOTS = "torchmetrics.utilities.plot"
_lock = threading.RLock()
_running: set[str] = set()
"""Packages that are being run, by the thread that has the lock."""


class LatePackage(ModuleType):
    """A package or module whose source hasn't run yet. :meth:`run` turns it into a usual module."""

    _submodules: tuple[str, ...] = ()
    """Those that can be imported before the package has run."""

    def run(self) -> None:
        """Run the package's source in this module; has no effect while this thread runs it."""
        with _lock:
            if not isinstance(self, LatePackage) or self.__name__ in _running:
                return
            _running.add(self.__name__)
            try:
                self.__spec__.loader.exec_module(self)
            except BaseException:
                sys.modules.pop(self.__name__, None)
                raise
            finally:
                _running.remove(self.__name__)
            self.__class__ = ModuleType

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(name)
        self.run()
        if isinstance(self, LatePackage):  # it is being run, and hasn't come to this name
            raise AttributeError(f"module {self.__name__!r} has no attribute {name!r}")
        return getattr(self, name)


class _Metrics(LatePackage):
    _submodules = ("metric", "collections", "utilities")

    def __getattr__(self, name: str) -> Any:
        if name == "Metric":
            # before metric, which can't be imported first
            utilities = importlib.import_module(f"{self.__name__}.utilities")
            utilities.plot = sys.modules[PLOTS]
            return importlib.import_module(f"{self.__name__}.metric").Metric
        if name == "MetricCollection":
            return importlib.import_module(f"{self.__name__}.collections").MetricCollection
        return super().__getattr__(name)


class _Submodules:
    """Finder that runs a package before a submodule of it is imported."""

    def find_spec(
        self, name: str, path: Optional[Sequence[str]] = None, target: Optional[ModuleType] = None
    ) -> Optional[ModuleSpec]:
        parent, _, own = name.rpartition(".")
        package = sys.modules.get(parent)
        if not isinstance(package, LatePackage) or own in package._submodules:
            return None
        package.run()
        # the package has imported it, so it must not be imported once more
        known = sys.modules.get(name)
        return None if known is None else ModuleSpec(name, _Known(known))


class _Known:
    """Loader of a module that is loaded."""

    def __init__(self, module: ModuleType) -> None:
        self.module, self.spec = module, module.__spec__

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return self.module

    def exec_module(self, module: ModuleType) -> None:
        module.__spec__ = self.spec


def import_lightning() -> None:
    """Import ``lightning.pytorch``, with torchmetrics and torch's compiler to be run at their first
    use. Where releases of these packages need more of each other than is defined here, they are
    imported as usual.
    """
    if "lightning" in sys.modules:
        return
    try:
        _install()
        importlib.import_module("lightning.pytorch")
    except Exception:
        _remove("lightning", "torchmetrics")
        if _compiler() is None:  # once it has run, it can't be imported again
            _remove("torch._dynamo")
        importlib.import_module("lightning.pytorch")


def _remove(*packages: str) -> None:
    """Let these packages be imported again."""
    for name in [*sys.modules]:
        if any(name == package or name.startswith(f"{package}.") for package in packages):
            parent, _, own = name.rpartition(".")
            if parent in sys.modules:
                vars(sys.modules[parent]).pop(own, None)
            del sys.modules[name]


def _install() -> None:
    """Put the packages that haven't been imported into ``sys.modules``."""
    if not any(isinstance(finder, _Submodules) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Submodules())
    if metrics := _late("torchmetrics", _Metrics):
        metrics.__version__ = metadata.version("torchmetrics")
        metrics._logger = logging.getLogger("torchmetrics")
        _install_plots(Path(metrics.__path__[0], "utilities"))
    if compiler := _late("torch._dynamo", LatePackage):
        torch._dynamo = compiler
        compiler.OptimizedModule = _OptimizedModule
        compiler.disable = _disable
        compiler.graph_break = lambda *_, **__: None  # it ends a graph; there is none


def _install_plots(folder: Path) -> None:
    """Put the module of torchmetrics that draws plots into ``sys.modules``; its base class of
    metrics needs three names of it.
    """
    plots = _late(PLOTS, LatePackage, [str(folder)])
    plots._AX_TYPE = plots._PLOT_OUT_TYPE = object  # of annotations

    def plot_single_or_multi_val(*args: Any, **options: Any) -> Any:
        LatePackage.run(plots)  # not its own method, which it has lost if it has run
        return plots.plot_single_or_multi_val(*args, **options)

    plots.plot_single_or_multi_val = plot_single_or_multi_val


def _late(
    name: str, kind: type[LatePackage], folders: Optional[list[str]] = None
) -> Optional[LatePackage]:
    """Put a package that hasn't been imported into ``sys.modules``; return None if it has been, or
    isn't there.

    Args:
        folders: where a submodule is, so that its package needn't run to find it.
    """
    if name in sys.modules:
        return None
    spec = find_spec(name) if folders is None else PathFinder.find_spec(name, folders)
    if spec is None:
        return None
    module = sys.modules[name] = module_from_spec(spec)
    module.__class__ = kind
    return module


def _compiler() -> Optional[ModuleType]:
    """Return torch's compiler, or None if it hasn't run."""
    compiler = sys.modules.get("torch._dynamo")
    return None if isinstance(compiler, LatePackage) else compiler


class _Compiled(type):
    def __instancecheck__(cls, module: Any) -> bool:
        compiler = _compiler()
        return compiler is not None and isinstance(module, compiler.OptimizedModule)


class _OptimizedModule(metaclass=_Compiled):
    """Stands for torch's class of compiled modules: nothing is one before the compiler has run."""


def _disable(
    function: Optional[Callable[..., Any]] = None, *args: Any, **options: Any
) -> Callable[..., Any]:
    """Return a function that the compiler leaves as it is; its own ``disable`` is called once it
    has run.
    """
    if function is None:
        return functools.partial(_disable, **options)

    @functools.cache
    def disabled(compiler: Optional[ModuleType]) -> Callable[..., Any]:
        return function if compiler is None else compiler.disable(function, *args, **options)

    @functools.wraps(function)
    def call(*arguments: Any, **named: Any) -> Any:
        return disabled(_compiler())(*arguments, **named)

    return call
