"""The backends of the stability tests: this machine's, and the CUDA kernels in emulation."""

import pytest
import torch

from tests.helpers.cuda_shim.device import HostDevice, unavailable
from threestudio_gaussiandreamer.splatting import available_backends, backends
from threestudio_gaussiandreamer.splatting.cuda import backend as cuda
from threestudio_gaussiandreamer.splatting.cuda import driver as cuda_driver

BACKENDS = [
    name for name, reason in available_backends().items() if reason is None and name != "cuda"
]
if unavailable() is None:
    BACKENDS.append("cuda")


def backends_of(*too_slow: str, without: tuple[str, ...] = ()) -> list:
    """Return values of a parameter ``backend``; those in emulation and of ``too_slow`` are slow."""
    marks = {name: pytest.mark.slow for name in ("cuda", *too_slow)}
    names = (name for name in BACKENDS if name not in without)
    return [pytest.param(name, marks=marks.get(name, ())) for name in names]


def slow(*values) -> list:
    """Mark values of a parameter as slow."""
    return [pytest.param(value, marks=pytest.mark.slow) for value in values]


def cuda_on_the_host(monkeypatch: pytest.MonkeyPatch) -> None:
    """Make the backend "cuda" accept CPU tensors and run its kernels in emulation."""
    host = HostDevice()
    monkeypatch.setitem(
        backends.BACKENDS, "cuda", backends.Backend(cuda, ("cpu",), (torch.float32,))
    )
    monkeypatch.setattr(cuda_driver, "unavailable", lambda: None)
    monkeypatch.setattr(cuda_driver, "device", lambda device: host)
    monkeypatch.setattr(cuda, "_estimates", {})
