"""An emulated GPU: the package's CUDA source, compiled for the host unchanged."""

import ctypes
import functools
import hashlib
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Optional

import pytest
import torch
from torch import Tensor

from threestudio_gaussiandreamer.splatting.cuda import nvrtc
from threestudio_gaussiandreamer.splatting.cuda.backend import NOWHERE

FOLDER = Path(__file__).parent
# Nothing is fused but what the kernels fuse on purpose; reading four floats as one is usual in
# CUDA, though not in C++; jumps from stack to stack are meant.
FLAGS = (
    "-std=c++17 -O2 -fPIC -shared -ffp-contract=off -fno-math-errno -fno-strict-aliasing".split()
)
FLAGS += ["-U_FORTIFY_SOURCE", "-Wall", "-Wno-unknown-pragmas"]


def unavailable() -> Optional[str]:
    """Return why the kernels can't be compiled for the host, or None."""
    if not sys.platform.startswith("linux"):
        return "the fibres and the sections of the stand-in are Linux's"
    return None if shutil.which("g++") else "needs g++ to compile the kernels for the host"


def _no_compiler() -> str:
    try:
        nvrtc.version()
    except OSError as error:
        return str(error)
    return ""


needs_nvrtc = pytest.mark.skipif(bool(_no_compiler()), reason=_no_compiler())
ORDERS = {"forward": 0, "backward": 1, "shuffled": 2}


@functools.cache
def library() -> ctypes.CDLL:
    """Return the kernels compiled for the host; the file is kept for other processes and runs."""
    folders = FOLDER, nvrtc.KERNELS, nvrtc.SHARED
    sources = [path for folder in folders for path in sorted(folder.glob("*.[ch]*"))]
    key = hashlib.sha256(b"".join(path.read_bytes() for path in sources)).hexdigest()[:16]
    target = FOLDER.parents[2] / ".pytest_cache" / f"kernels-{key}.so"
    if not target.exists():
        target.parent.mkdir(exist_ok=True)
        part = target.with_suffix(f".{os.getpid()}")
        files = [*(f"-I{folder}" for folder in folders), *map(str, FOLDER.glob("*.cpp"))]
        subprocess.run(["g++", *FLAGS, *files, "-o", str(part)], check=True)
        part.replace(target)
    kernels = ctypes.CDLL(str(target))
    kernels.shim_error.restype = ctypes.c_char_p
    return kernels


class Now:
    """Values that have arrived, but are reported as such only when the test says so."""

    def __init__(self, device: "HostDevice", ends: Tensor):
        self.device, self.ends = device, ends.clone()

    def ready(self) -> bool:
        return self.device.arrived

    def values(self) -> Tensor:
        self.device.waits += 1
        return self.ends


class HostDevice:
    """Like `driver.Gpu`, for CPU tensors.

    Args:
        order: of the threads of a block between barriers: "forward", "backward" or "shuffled".
        most_intersections: larger lists or rows raise an out-of-memory error.
        arrived: whether values that are read later are reported as arrived.
    """

    def __init__(self, order="forward", most_intersections=NOWHERE, arrived=True):
        self.order, self.most_intersections = ORDERS[order], most_intersections
        self.arrived, self.waits = arrived, 0
        self.launched: list[str] = []

    def describe(self) -> str:
        return "the stand-in"

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments) -> None:
        self.launched.append(name)
        limited = name in ("list_tiles", "blend_backward", "blend_backward_absolute")
        if limited and max(map(_length, arguments)) > self.most_intersections:
            raise torch.cuda.OutOfMemoryError("no memory, says the test")
        values = [ctypes.c_void_p(x.data_ptr()) if isinstance(x, Tensor) else x for x in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(x) for x in values))
        if library().shim_launch(name.encode(), *grid, threads, self.order, pointers):
            raise AssertionError(f"{name}: {library().shim_error().decode()}")

    def read_async(self, ends: Tensor) -> Now:
        return Now(self, ends)


def _length(argument) -> int:
    """Return how many intersections, or rows of them, it has room for."""
    is_list = isinstance(argument, Tensor) and (argument.dim() == 1 or argument.shape[1:] == (12,))
    return len(argument) if is_list else 0
