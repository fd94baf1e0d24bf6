"""The table of backends, which of them are available, and the choice of one."""

import functools
import logging
from dataclasses import dataclass
from types import ModuleType
from typing import Optional

import torch
from torch import Tensor

from ..core.errors import UserError, unknown
from . import reference, torch_backend
from .cpu import backend as cpu
from .cuda import backend as cuda
from .cuda import proof

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Backend:
    """A module with ``rasterize(scene, options)`` and, unless it runs everywhere,
    ``unavailable()``; the devices and types of tensors that it supports.

    ``proof`` is a module with ``failure(device)``, which compares the backend with plain torch on
    a device before it is first used there.
    """

    module: ModuleType
    devices: Optional[tuple[str, ...]] = None  # None: any
    dtypes: tuple[torch.dtype, ...] = (torch.float32, torch.float64)
    proof: Optional[ModuleType] = None

    def unavailable(self) -> Optional[str]:
        """Return why the backend can't run on this machine, or None if it can."""
        return None if self.devices is None else self.module.unavailable()

    def takes(self, tensor: Tensor) -> bool:
        of_device = self.devices is None or tensor.device.type in self.devices
        return of_device and tensor.dtype in self.dtypes

    def refuses(self, tensor: Tensor) -> Optional[str]:
        """Return why the backend can't be used with tensors like this one, or None if it can."""
        reason = self.unavailable()
        if reason is None and not self.takes(tensor):
            places, kinds = (" or ".join(map(str, x or ())) for x in (self.devices, self.dtypes))
            reason = f"it takes {kinds} on {places}, these are {tensor.dtype} on {tensor.device}"
        return self.proof.failure(tensor.device) if reason is None and self.proof else reason


# In order of preference for "auto", which never gets to "reference", since "torch" always runs.
BACKENDS = {
    "cpu": Backend(cpu, ("cpu",), (torch.float32,)),
    "cuda": Backend(cuda, ("cuda",), (torch.float32,), proof),
    "torch": Backend(torch_backend),
    "reference": Backend(reference),
}


def available_backends() -> dict[str, Optional[str]]:
    """Map the name of each backend to None, or to the reason why it can't run on this machine."""
    return {name: backend.unavailable() for name, backend in BACKENDS.items()}


def choose_backend(name: str, tensor: Tensor) -> Backend:
    """Return the backend with this name, or for "auto" the first one that supports the tensor;
    warn, once per reason, if a compiled one that supports it can't run.

    Raises:
        UserError: there is no backend with this name, or it can't run or doesn't support the
            tensor's device or type, or differs from plain torch on this device.
    """
    if name not in ("auto", *BACKENDS):
        raise unknown("backend", name, ["auto", *BACKENDS])
    if name == "auto":
        for known, backend in BACKENDS.items():
            if not backend.takes(tensor):
                continue
            reason = backend.refuses(tensor)
            if reason is None:
                return backend
            _warn_once(
                f"splatting in plain torch, many times slower than backend {known!r}, which "
                f"can't run: {reason}."
            )
    reason = BACKENDS[name].refuses(tensor)
    if reason is not None:
        usable = (known for known, other in BACKENDS.items() if other.refuses(tensor) is None)
        raise UserError(
            f"the backend {name!r} can't run: {reason}. Use backend='auto', or one of "
            f"{', '.join(usable)}."
        )
    return BACKENDS[name]


@functools.cache
def _warn_once(message: str) -> None:
    log.warning(message)
