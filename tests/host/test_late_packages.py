"""Packages that run at their first use, and what a run then imports."""

import importlib
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import ModuleType

import pytest

from threestudio_gaussiandreamer.host.builtin import late_packages
from threestudio_gaussiandreamer.host.builtin.late_packages import LatePackage


@pytest.fixture
def package(tmp_path, monkeypatch):
    """Return a late package with two submodules, of which it imports one; it counts its runs."""
    folder = tmp_path / "slow_to_run"
    folder.mkdir()
    (folder / "__init__.py").write_text(
        "runs = globals().get('runs', 0) + 1\nfrom . import used\nname = used.value\n"
    )
    (folder / "used.py").write_text("value = object()\n")
    (folder / "other.py").write_text("from . import name\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(sys, "meta_path", [late_packages._Submodules(), *sys.meta_path])
    yield late_packages._late("slow_to_run", LatePackage)
    late_packages._remove("slow_to_run")


def test_a_package_runs_at_its_first_use_and_only_once(package):
    assert sys.modules["slow_to_run"] is package and "slow_to_run.used" not in sys.modules
    assert not hasattr(package, "__version__") and isinstance(package, LatePackage)
    assert package.name is package.used.value
    assert package.runs == 1 and type(package) is ModuleType
    with pytest.raises(AttributeError, match="no attribute 'missing'"):
        assert package.missing


@pytest.mark.parametrize("submodule", ["used", "other"])
def test_a_package_runs_before_its_submodules_and_neither_twice(package, submodule):
    module = importlib.import_module(f"slow_to_run.{submodule}")
    assert package.runs == 1 and package.used is sys.modules["slow_to_run.used"]
    assert module is sys.modules[f"slow_to_run.{submodule}"] and module.__spec__.origin
    assert importlib.reload(package.used).value is not package.name


def test_another_thread_waits_until_a_package_has_run(package, tmp_path):
    source = tmp_path / "slow_to_run" / "__init__.py"
    source.write_text("import time\ntime.sleep(0.2)\nname = 1\n")
    with ThreadPoolExecutor(2) as pool:
        assert list(pool.map(lambda _: package.name, range(2))) == [1, 1]


def test_all_names_of_a_package_can_be_imported(package):
    namespace = {}
    exec("from slow_to_run import *", namespace)
    assert namespace["name"] is package.name


def test_a_package_that_fails_can_be_imported_again(package, tmp_path):
    source = tmp_path / "slow_to_run" / "__init__.py"
    source.write_text("raise ValueError('broken')\n")
    with pytest.raises(ValueError, match="broken"):
        assert package.anything
    source.write_text("mended = True\n")
    importlib.invalidate_caches()
    assert importlib.import_module("slow_to_run").mended


def test_what_is_imported_already_or_not_installed_stays_as_it_is():
    assert (
        late_packages._late("json", LatePackage) is None and type(sys.modules["json"]) is ModuleType
    )
    assert late_packages._late("no_such_package", LatePackage) is None


def test_disabled_functions_keep_their_names_and_results():
    @late_packages._disable(recursive=False)
    def double(number):
        """Return twice the number."""
        return 2 * number

    assert double(3) == 6 and double.__doc__ == "Return twice the number."


TRAINING = """
import sys, torch
import threestudio_gaussiandreamer.host
from threestudio_gaussiandreamer.host.builtin.late_packages import LatePackage
weight = torch.nn.Parameter(torch.ones(2))
optimizer = torch.optim.Adam([weight], lr=0.1)
weight.square().sum().backward()
optimizer.step(), optimizer.zero_grad()
late = ("torch._dynamo", "torchmetrics", "torchmetrics.utilities.plot")
print([isinstance(sys.modules[name], LatePackage) for name in late])
print({"scipy.signal", "transformers", "matplotlib"} & sys.modules.keys())
"""
USED = """
import torch
import threestudio_gaussiandreamer.host
from lightning.fabric.wrappers import _unwrap_compiled
from lightning.pytorch.utilities.types import Metric
network = torch.nn.Linear(2, 2)
compiled = torch.compile(network, backend="eager")
x = torch.ones(1, 2)
torch.testing.assert_close(compiled(x), network(x))
assert _unwrap_compiled(compiled)[0] is network and _unwrap_compiled(network)[0] is network
import torchmetrics
from torchmetrics.functional.regression import mean_squared_error
assert isinstance(torchmetrics.MeanMetric(), Metric) and mean_squared_error(x, x) == 0
print("used")
"""
PLOTTED = """
import sys, torch
import threestudio_gaussiandreamer.host
from lightning.pytorch.utilities.types import Metric

class Constant(Metric):
    update = lambda self: None
    compute = lambda self: torch.tensor(2.0)

import torchmetrics
for use in (lambda: None, lambda: torchmetrics.MeanMetric):  # before torchmetrics runs, and after
    use()
    figure, axes = Constant()._plot(torch.tensor(2.0))
    print(type(figure).__name__, axes.get_lines()[0].get_ydata())
import torchmetrics.utilities.plot
assert callable(torchmetrics.utilities.plot.plot_curve)
"""
INCOMPATIBLE = f"""
import importlib.util, sys
spec = importlib.util.spec_from_file_location("late_packages", {late_packages.__file__!r})
alone = importlib.util.module_from_spec(spec)  # before the host has imported Lightning
spec.loader.exec_module(alone)
alone._Metrics.__getattr__ = lambda module, name: missing_in_this_release
alone.import_lightning()
import lightning.pytorch, torchmetrics
print(type(torchmetrics).__name__, lightning.pytorch.Trainer.__name__)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "code, printed",
    [
        (TRAINING, "[True, True, True]\nset()"),
        (USED, "used"),
        (INCOMPATIBLE, "module Trainer"),
    ],
)
def test_lightning_and_the_optimisers_run_none_until_they_are_used(code, printed):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == printed, done.stderr


@pytest.mark.slow
def test_metrics_are_plotted_as_if_nothing_were_late(monkeypatch):
    pytest.importorskip("matplotlib")
    monkeypatch.setenv("MPLBACKEND", "Agg")
    done = subprocess.run([sys.executable, "-c", PLOTTED], capture_output=True, text=True)
    printed = "Figure [2.]\nFigure [2.]"
    assert done.stdout.strip() == printed, done.stderr
