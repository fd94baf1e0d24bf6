"""Fixtures of all tests: small clouds, and an isolated environment."""

import os

# before torch is imported: spinning barriers are slow on a busy machine
os.environ.setdefault("OMP_WAIT_POLICY", "passive")
os.environ.setdefault("HF_HUB_OFFLINE", "1")
# the tests' tensors are the CPU's; what needs a GPU is in benchmarks/splatting/gpu_check.py
os.environ["CUDA_VISIBLE_DEVICES"] = ""

import signal

import numpy as np
import pytest
from hypothesis import settings

from threestudio_gaussiandreamer.core import logs
from threestudio_gaussiandreamer.gaussians.point_cloud import PointCloud

# a busy machine exceeds any deadline; the same inputs every time
settings.register_profile("repeatable", deadline=None, derandomize=True)
settings.load_profile("repeatable")


@pytest.fixture(autouse=True, scope="session")
def default_signals():
    """Restore the handlers of Ctrl-C and SIGHUP, which background jobs and nohup ignore."""
    signal.signal(signal.SIGINT, signal.default_int_handler)
    if hasattr(signal, "SIGHUP"):
        signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(autouse=True)
def no_traces_of_runs(monkeypatch):
    """Undo what an earlier run left: the seed, and that ``caplog`` doesn't see our messages."""
    monkeypatch.setenv("PL_GLOBAL_SEED", "0")
    monkeypatch.setattr(logs.logger, "propagate", True)


@pytest.fixture
def recorded(monkeypatch):
    """Return a function that lists the arguments and the result of each later call of a method."""

    def record(owner, name):
        calls, original = [], getattr(owner, name)

        def call(*args, **options):
            calls.append((args, original(*args, **options)))
            return calls[-1][1]

        monkeypatch.setattr(owner, name, call)
        return calls

    return record


@pytest.fixture
def sphere_points() -> PointCloud:
    """Return 400 points on a sphere of radius 0.7, coloured by position."""
    rng = np.random.default_rng(0)
    points = rng.normal(size=(400, 3))
    points *= 0.7 / np.linalg.norm(points, axis=1, keepdims=True)
    return PointCloud(points.astype(np.float32), (points / 1.4 + 0.5).astype(np.float32))
