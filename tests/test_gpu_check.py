"""The check for machines with a GPU runs from end to end: here on the CPU, with everything tiny."""

import json
import subprocess
import sys
from pathlib import Path

import pytest
import torch

SCRIPT = Path(__file__).parents[1] / "benchmarks" / "gpu_check.py"


def check(*arguments):
    return subprocess.run([sys.executable, SCRIPT, *map(str, arguments)], capture_output=True, text=True)


@pytest.mark.slow
def test_every_section_runs_and_reports(tmp_path):
    pytest.importorskip("diffusers")
    done = check("--device", "cpu", "--small", "--out", tmp_path / "report.json")
    assert done.returncode == 0, done.stdout + done.stderr
    report = json.loads((tmp_path / "report.json").read_text())
    assert all(cell["gradient"] < 2e-5 for cell in report["correct"]["relative_errors"].values())
    assert report["train"]["default"]["seconds_per_step"] > 0 and report["train"]["lowmem"]["seconds_per_step"] > 0
    assert report["compile"]["first"] > 0 and report["bench"]["fast"]["ms"] > 0


@pytest.mark.slow
def test_what_fails_is_recorded_and_the_rest_goes_on(tmp_path):
    code = f"""
import sys
sys.path.insert(0, {str(SCRIPT.parent)!r})
import gpu_check
gpu_check.GRADIENT_ERROR = 0.0
gpu_check.SECTIONS = {{name: gpu_check.SECTIONS[name] for name in ("correct", "bench")}}
sys.exit(gpu_check.main(["--device", "cpu", "--small", "--out", {str(tmp_path / "report.json")!r}]))
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    report = json.loads((tmp_path / "report.json").read_text())
    assert done.returncode == 1 and "gradient by" in report["correct"]["failed"] and report["bench"]["fast"]["ms"] > 0


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_without_a_gpu_it_says_so():
    done = check()
    assert done.returncode == 2 and "no NVIDIA GPU" in done.stderr
