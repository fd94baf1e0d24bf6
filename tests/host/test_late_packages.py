"""Lightning is imported without what a run doesn't use, which works as usual once it is used."""

import subprocess
import sys

import pytest

from threestudio_gaussiandreamer.host.builtin import late_packages

TRAINING = """
import sys, torch
import threestudio_gaussiandreamer.host
from threestudio_gaussiandreamer.host.builtin.late_packages import Late
weight = torch.nn.Parameter(torch.ones(2))
optimizer = torch.optim.Adam([weight], lr=0.1)
weight.square().sum().backward()
optimizer.step(), optimizer.zero_grad()
assert torch.compiler.disable(recursive=False)(len) is torch.compiler.disable(len) is len
late = ("torch._dynamo", "torchmetrics")
print([isinstance(sys.modules[name], Late) for name in late])
print({"scipy.signal", "transformers"} & sys.modules.keys())
"""
USED = """
import torch
import threestudio_gaussiandreamer.host
from lightning.pytorch.utilities.types import Metric
network = torch.nn.Linear(2, 2)
compiled = torch.compile(network, backend="eager")
x = torch.ones(1, 2)
torch.testing.assert_close(compiled(x), network(x))
from torch._dynamo.utils import counters
assert counters["frames"]["ok"]
import torchmetrics
from torchmetrics.functional.regression import mean_squared_error
assert isinstance(torchmetrics.MeanMetric(), Metric) and mean_squared_error(x, x) == 0
print("used")
"""
INCOMPATIBLE = f"""
import importlib.util, torch
spec = importlib.util.spec_from_file_location("late_packages", {late_packages.__file__!r})
alone = importlib.util.module_from_spec(spec)  # before the host has imported Lightning
spec.loader.exec_module(alone)
missing = f"{{alone.METRICS}}.collections"
alone.import_module = lambda name: 1 / 0 if name == missing else importlib.import_module(name)
alone.import_lightning()
import lightning.pytorch, torchmetrics
print(type(torchmetrics).__name__, lightning.pytorch.Trainer.__name__)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "code, printed",
    [(TRAINING, "[True, True]\nset()"), (USED, "used"), (INCOMPATIBLE, "module Trainer")],
)
def test_lightning_and_the_optimisers_run_none_until_they_are_used(code, printed):
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == printed, done.stderr
