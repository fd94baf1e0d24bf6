"""What a run imports and does before its first step."""

import subprocess
import sys

import pytest

from benchmarks.start.first_step import PROBE, ROOT
from benchmarks.start.launched import run_with_probe
from tests.training.runs import SMALL

UNUSED = {
    "trimesh", "networkx", "diffusers", "transformers", "viser", "imageio", "matplotlib",
    "tensorboard.backend", "accelerate", "scipy.stats", "scipy.signal", "torchmetrics.functional",
    "torch._dynamo.eval_frame", "sympy",
}  # fmt: skip


@pytest.mark.slow
def test_a_demo_run_imports_nothing_heavy_that_it_does_not_use():
    modules = set(run_with_probe(PROBE, ROOT, *SMALL)["modules"])
    assert {"torch", "lightning", "threestudio_gaussiandreamer.training.system"} <= modules
    assert not UNUSED & modules


@pytest.mark.slow
def test_the_commands_for_files_import_no_lightning():
    """It takes three times as long as what they use."""
    rooms = ("convert", "prune", "view")
    names = ", ".join(f"threestudio_gaussiandreamer.{room}.command" for room in rooms)
    code = f"import sys, {names}; print(*sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(done.stdout.split())
    assert "torch" in modules and not {"lightning", "pytorch_lightning", "omegaconf"} & modules
