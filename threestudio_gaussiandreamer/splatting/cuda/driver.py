"""Load the kernels that `nvrtc` compiled, and launch them on torch's current stream, through the
CUDA driver API.

The few functions needed are called through ctypes from the driver's own library, so neither
cuda-bindings nor a CUDA toolkit is required."""

import ctypes
import functools
import re
import sys
from pathlib import Path
from typing import Any, Optional

import torch
from torch import Tensor

from ...core.devices import HostCopy
from ...core.errors import UserError
from . import nvrtc
from .nvrtc import release

# The .cu file of each kernel.
UNITS = {
    "project": "project",
    "count_tiles": "bin",
    "list_tiles": "bin",
    "find_tiles": "bin",
    "blend": "blend",
    "blend_backward": "blend_backward",
    "blend_backward_absolute": "blend_backward",
    "sum_rows": "project_backward",
    "project_backward": "project_backward",
    "sum_cameras": "project_backward",
}
LIBRARY = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
VERSION_FILE = Path("/proc/driver/nvidia/version")


@functools.cache
def unavailable() -> Optional[str]:
    """Return why no GPU can be used, or None if one can; the answer is cached.

    Machine code runs on drivers of the same major CUDA release or a later one."""
    if torch.version.cuda is None:
        return f"this torch ({torch.__version__}) is built without CUDA; install a CUDA build of it"
    if not torch.cuda.is_available():
        return f"torch finds no NVIDIA GPU, or no driver that its CUDA {torch.version.cuda} can use"
    try:
        nvrtc.target_for(torch.cuda.get_device_capability())
        knows, compiler = driver_version(), nvrtc.version()
    except (OSError, AttributeError, UserError) as error:  # a library may lack a function
        return str(error)
    if knows[0] < compiler[0]:
        advice = f"update the driver, or install a torch built for CUDA {knows[0]}"
        return (
            f"the NVIDIA driver knows CUDA up to {release(knows)}, the compiler is of CUDA "
            f"{release(compiler)}: {advice}"
        )


def device(device: torch.device) -> "Gpu":
    """Return the GPU that holds tensors of this device."""
    return _gpu(torch.cuda.current_device() if device.index is None else device.index)


class Gpu:
    """One device. Kernels are compiled, or read from the cache, when they are first launched."""

    def __init__(self, index: int):
        self.index = index
        self.target = nvrtc.target_for(torch.cuda.get_device_capability(index))
        self.functions: dict[str, ctypes.c_void_p] = {}
        torch.cuda.init()
        device, self.context = ctypes.c_int(), ctypes.c_void_p()
        _call("starting the driver", "cuInit", 0)
        # torch and the driver both number the devices in CUDA_VISIBLE_DEVICES
        _call("finding the GPU", "cuDeviceGet", ctypes.byref(device), index)
        # the primary context, which torch uses too
        context = ctypes.byref(self.context)
        _call("using the GPU", "cuDevicePrimaryCtxRetain", context, device)

    def describe(self) -> str:
        """Return the names and releases that the kernels' results may depend on."""
        return (
            f"{torch.cuda.get_device_name(self.index)}, {self.target}, driver {driver_build()}of "
            f"CUDA {release(driver_version())}, NVRTC of CUDA {release(nvrtc.version())}"
        )

    def launch(self, name: str, grid: tuple[int, int], threads: int, *arguments: Any) -> None:
        """Queue a kernel on torch's current stream, with tensors, structures and C numbers."""
        values = [ctypes.c_void_p(x.data_ptr()) if isinstance(x, Tensor) else x for x in arguments]
        pointers = (ctypes.c_void_p * len(values))(*(ctypes.addressof(x) for x in values))
        with torch.cuda.device(self.index):
            # a new thread, such as autograd's, has no current context
            _call("using the GPU", "cuCtxSetCurrent", self.context)
            if name not in self.functions:
                self._load(UNITS[name])
            stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
            sizes, doing = (*grid, 1, threads, 1, 1, 0), f"launching the kernel {name}"
            _call(doing, "cuLaunchKernel", self.functions[name], *sizes, stream, pointers, None)

    def read_async(self, numbers: Tensor) -> HostCopy:
        with torch.cuda.device(self.index):
            return HostCopy(numbers.contiguous())

    def _load(self, unit: str) -> None:
        """Load the kernels of a .cu file."""
        module, code = ctypes.c_void_p(), nvrtc.machine_code(unit, self.target)
        compiler, driver = release(nvrtc.version()), release(driver_version())
        releases = f"NVRTC of CUDA {compiler}, driver of CUDA {driver}"
        doing = f"loading {unit}.cu for {self.target} ({releases})"
        _call(doing, "cuModuleLoadData", ctypes.byref(module), code)
        for name in (name for name, file in UNITS.items() if file == unit):
            function, doing = ctypes.c_void_p(), f"finding the kernel {name}"
            _call(doing, "cuModuleGetFunction", ctypes.byref(function), module, name.encode())
            self.functions[name] = function


@functools.cache
def _gpu(index: int) -> Gpu:
    return Gpu(index)


def driver_version() -> tuple[int, int]:
    """Return (major, minor) of the newest CUDA release that the driver supports."""
    found = ctypes.c_int()
    _call("asking for the driver's version", "cuDriverGetVersion", ctypes.byref(found))
    return found.value // 1000, found.value % 1000 // 10


def driver_build() -> str:
    """Return the driver's own version and a space, as "580.65.06 "; empty where the system has no
    such file, as Windows, including its Linux subsystem.
    """
    try:
        found = re.search(r"\d+(\.\d+)+", VERSION_FILE.read_bytes().decode(errors="replace"))
    except OSError:
        return ""
    return f"{found[0]} " if found else ""


@functools.cache
def _driver() -> ctypes.CDLL:
    driver = ctypes.CDLL(LIBRARY)
    unsigned, pointer = ctypes.c_uint, ctypes.c_void_p
    driver.cuCtxSetCurrent.argtypes = [pointer]
    driver.cuDevicePrimaryCtxRetain.argtypes = [pointer, ctypes.c_int]
    driver.cuLaunchKernel.argtypes = [pointer, *[unsigned] * 7, pointer, pointer, pointer]
    driver.cuModuleLoadData.argtypes = [pointer, ctypes.c_char_p]
    driver.cuModuleGetFunction.argtypes = [pointer, pointer, ctypes.c_char_p]
    return driver


def _call(doing: str, name: str, *arguments: Any) -> None:
    """Call a function of the driver; UserError if it fails at ``doing``."""
    status = getattr(_driver(), name)(*arguments)
    if status:
        text = ctypes.c_char_p()
        _driver().cuGetErrorString(status, ctypes.byref(text))
        raise UserError(
            f"CUDA failed at {doing}: {(text.value or b'unknown error').decode()} ({status})."
        )
