"""Import Lightning without most of torchmetrics and torch's compiler, which a run doesn't use: they
take 5 of 9 CPU seconds of a start. Their source runs at the first use of a name that isn't here."""

import logging
import sys
from importlib import import_module, metadata
from importlib.machinery import ModuleSpec
from importlib.util import find_spec, module_from_spec
from types import ModuleType, SimpleNamespace
from typing import Any, Optional

METRICS, COMPILER = "torchmetrics", "torch._dynamo"
LOGGER = logging.getLogger(METRICS)


class Late(ModuleType):
    """A package whose source hasn't run yet."""

    def __init__(self, name: str, **names: Any) -> None:
        super().__init__(name)
        vars(self).update(vars(module_from_spec(find_spec(name))), **names)
        sys.modules[name] = self

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__") and name != "__all__":
            raise AttributeError(name)
        self.__class__ = ModuleType
        self.__spec__.loader.exec_module(self)
        return getattr(self, name)

    @staticmethod
    def find_spec(name: str, path: Any = None, target: Any = None) -> Optional[ModuleSpec]:
        """Run the compiler before a submodule of it is imported, as a finder of modules."""
        if not name.startswith(f"{COMPILER}.") or type(sys.modules[COMPILER]) is not Late:
            return None
        _ = sys.modules[COMPILER].optimize
        known = sys.modules.get(name)  # imported by the package: it mustn't run again
        loader = SimpleNamespace(create_module=lambda _: known, exec_module=lambda _: None)
        return ModuleSpec(name, loader) if known else None


def import_lightning() -> None:
    """Import ``lightning.pytorch``, as usual where a release needs more than is defined here."""
    if not {"lightning", METRICS, COMPILER} & sys.modules.keys():
        try:
            sys.meta_path.insert(0, Late)
            names = {
                "disable": lambda function=None, *_, **__: function or (lambda found: found),
                "graph_break": lambda *_, **__: None,
                "OptimizedModule": type("OptimizedModule", (), {}),
            }
            vars(sys.modules["torch"])["_dynamo"] = Late(COMPILER, **names)
            package = Late(METRICS, __version__=metadata.version(METRICS), _logger=LOGGER)
            import_module(f"{METRICS}.utilities")  # before metric, which it imports
            package.Metric = import_module(f"{METRICS}.metric").Metric
            package.MetricCollection = import_module(f"{METRICS}.collections").MetricCollection
            import_module("lightning.pytorch")
        except Exception:
            for name in [*sys.modules]:
                if name.partition(".")[0] in ("lightning", METRICS):
                    del sys.modules[name]
    import_module("lightning.pytorch")
