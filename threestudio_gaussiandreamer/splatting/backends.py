"""The table of backends, which of them are available, and the choice of one."""

import functools
import importlib
import logging
from dataclasses import dataclass
from types import ModuleType
from typing import Optional

import torch
from torch import Tensor

from ..core.errors import UserError, unknown

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Backend:
    """A module of this package with ``rasterize(scene, options)`` and ``unavailable()``, and the
    devices and types of tensors that it supports.

    ``proof`` is a module with ``failure(device)``, which compares the backend with plain torch on
    a device before it is first used there.
    """

    module: str
    devices: Optional[tuple[str, ...]] = None  # None: any
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    proof: Optional[str] = None

    def load(self) -> ModuleType:
        return _import(self.module)

    def refuses(self, tensor: Tensor) -> Optional[str]:
        """Return why the backend can't be used with tensors like this one, or None if it can."""
        if self.devices is not None and tensor.device.type not in self.devices:
            return f"it takes tensors on {' or '.join(self.devices)}, these are on {tensor.device}"
        if tensor.dtype not in self.dtypes:
            return f"it takes {' or '.join(map(str, self.dtypes))}, these are {tensor.dtype}"
        unavailable = self.load().unavailable()
        if unavailable is not None or self.proof is None:
            return unavailable
        return _import(self.proof).failure(tensor.device)


@functools.cache
def _import(module: str) -> ModuleType:
    return importlib.import_module(f".{module}", __package__)


# In order of preference for "auto", which never gets to "reference", since "torch" always runs.
BACKENDS = {
    "cpu": Backend("cpu.backend", devices=("cpu",), dtypes=(torch.float32,)),
    "cuda": Backend("cuda.backend", devices=("cuda",), dtypes=(torch.float32,), proof="cuda.proof"),
    "torch": Backend("torch_backend"),
    "reference": Backend("reference"),
}


def available_backends() -> dict[str, Optional[str]]:
    """Map the name of each backend to None, or to the reason why it can't run on this machine."""
    return {name: backend.load().unavailable() for name, backend in BACKENDS.items()}


def refusal(name: str, device: torch.device) -> Optional[str]:
    """Return why a backend can't draw on a device, or None if it can. Where that is due, it is
    compared with plain torch there.
    """
    return BACKENDS[name].refuses(torch.empty(0, device=device))


def choose_backend(name: str, tensor: Tensor) -> Backend:
    """Return the backend with this name, or for "auto" the first one that supports the tensor.

    Raises:
        UserError: there is no backend with this name, or it can't run or doesn't support the
            tensor's device or type, or differs from plain torch on this device.
    """
    if name not in ("auto", *BACKENDS):
        raise unknown("backend", name, ["auto", *BACKENDS])
    usable = (known for known, backend in BACKENDS.items() if backend.refuses(tensor) is None)
    if name == "auto":
        name = next(usable)
        _report_slow_path(name, tensor)
        return BACKENDS[name]
    refusal = BACKENDS[name].refuses(tensor)
    if refusal is not None:
        raise UserError(
            f"the backend {name!r} can't run: {refusal}. Use backend='auto', or one of "
            f"{', '.join(usable)}."
        )
    return BACKENDS[name]


def _report_slow_path(chosen: str, tensor: Tensor) -> None:
    """Warn, once per reason, that a compiled backend which supports the tensor isn't available."""
    for name, backend in BACKENDS.items():
        if (
            name != chosen
            and tensor.device.type in (backend.devices or ())
            and tensor.dtype in backend.dtypes
        ):
            _warn_once(
                f"splatting in plain torch, many times slower than backend {name!r}, which "
                f"can't run: {backend.refuses(tensor)}."
            )


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
