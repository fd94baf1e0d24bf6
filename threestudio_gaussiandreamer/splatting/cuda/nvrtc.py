"""Compile CUDA C++ at run time with NVRTC, called through ctypes, and cache the result on disk.

Neither a compiler nor a CUDA toolkit is needed: every CUDA build of torch comes with libnvrtc. The
environment variable GAUSSIANDREAMER_NVRTC names another library. Compiled kernels are kept in the
folder GAUSSIANDREAMER_CACHE, by default in the user's cache folder, under a hash of sources,
options and compiler version.
"""

import ctypes
import functools
import glob
import hashlib
import logging
import os
import re
import sys
import sysconfig
from pathlib import Path
from typing import Optional

import torch

from ...core.errors import UserError
from ...core.files import write_file

KERNELS = Path(__file__).parent
SHARED = KERNELS.parent / "shared"  # formulas, which the CPU kernel includes too
# line numbers are for profilers and sanitizers
OPTIONS = ("--std=c++17", "--ptxas-options=-v", "--generate-line-info")
# Blending divides by 1 - alpha and takes powers once per pair of splat and pixel; subnormal numbers
# and the last bit of a quotient are not visible there.
UNIT_OPTIONS = {name: ("--ftz=true", "--prec-div=false") for name in ("blend", "blend_backward")}
OLDEST_ARCHITECTURE = 75
DIGEST = hashlib.sha256().digest_size
log = logging.getLogger(__name__)


def version() -> tuple[int, int]:
    """Return (major, minor) of the compiler's CUDA release."""
    major, minor = ctypes.c_int(), ctypes.c_int()
    _check(_library().nvrtcVersion(ctypes.byref(major), ctypes.byref(minor)))
    return major.value, minor.value


def release(version: tuple[int, int]) -> str:
    return ".".join(map(str, version))


def architectures() -> list[int]:
    """List the compute capabilities that the compiler supports, times ten: 75, 80, ..."""
    count = ctypes.c_int()
    _check(_library().nvrtcGetNumSupportedArchs(ctypes.byref(count)))
    known = (ctypes.c_int * count.value)()
    _check(_library().nvrtcGetSupportedArchs(known))
    return list(known)


def target_for(capability: tuple[int, int]) -> str:
    """Return the compilation target for a device of this compute capability.

    It is machine code ("sm_90") if the compiler supports the device. For a newer one it is PTX for
    the newest architecture that the compiler supports ("compute_..."), compiled by the driver.

    Raises:
        UserError: the device is older than what the kernels or the compiler support.
    """
    device, known = 10 * capability[0] + capability[1], architectures()
    older = [number for number in known if OLDEST_ARCHITECTURE <= number <= device]
    if not older:
        oldest = max(OLDEST_ARCHITECTURE, min(known))
        raise UserError(
            f"this GPU has compute capability {release(capability)}; the CUDA backend, compiled by "
            f"the NVRTC of CUDA {release(version())}, needs {oldest // 10}.{oldest % 10} or later: "
            "use backend='torch'."
        )
    return f"sm_{device}" if device in known else f"compute_{max(older)}"


def machine_code(unit: str, target: str) -> bytes:
    """Return ``<unit>.cu`` compiled for a target of `target_for`, from the cache if it is there."""
    name = f"{unit}-{target}-{_key(unit, target)}"
    found = read_cached(name)
    if found is None:
        log.info("compiling the CUDA kernels of %s.cu for %s", unit, target)
        found, _ = compile_unit(unit, target)
        write_cached(name, found)
    return found


def compile_unit(unit: str, target: str) -> tuple[bytes, str]:
    """Compile ``<unit>.cu``; return the cubin, or PTX with its NUL, and the compiler's log of
    registers, shared memory and spills of each kernel.

    Raises:
        UserError: the compiler rejects it.
    """
    nvrtc, program, texts = _library(), ctypes.c_void_p(), headers()
    sources = (source(unit).encode(), f"{unit}.cu".encode())
    included = (len(texts), _strings(texts.values()), _strings(texts))
    _check(nvrtc.nvrtcCreateProgram(ctypes.byref(program), *sources, *included))
    try:
        options = options_of(unit, target)
        status = nvrtc.nvrtcCompileProgram(program, len(options), _strings(options))
        messages = _bytes("ProgramLog", program).rstrip(b"\0").decode()
        if status:
            raise UserError(
                f"the NVRTC of CUDA {release(version())} can't compile {unit}.cu for {target}: "
                f"{_error(status)}\n{messages}"
            )
        code = _bytes("CUBIN" if target.startswith("sm_") else "PTX", program)
        return code, messages
    finally:
        nvrtc.nvrtcDestroyProgram(ctypes.byref(program))


def source(unit: str) -> str:
    return (KERNELS / f"{unit}.cu").read_text(encoding="utf-8")


@functools.cache
def headers() -> dict[str, str]:
    """Return the text of each header that a ``.cu`` file may include, by name."""
    return {
        path.name: path.read_text(encoding="utf-8")
        for path in (*sorted(KERNELS.glob("*.h")), *sorted(SHARED.glob("*.h")))
    }


def options_of(unit: str, target: str) -> tuple[str, ...]:
    return (f"--gpu-architecture={target}", *OPTIONS, *UNIT_OPTIONS.get(unit, ()))


# ---- the cache -----------------------------------------------------------------------------------


def cache_folder() -> Path:
    """Return where compiled kernels are kept.

    Raises:
        RuntimeError: neither variables nor the system say where the user's home is (in containers).
    """
    if folder := os.environ.get("GAUSSIANDREAMER_CACHE"):
        return Path(folder).expanduser()
    caches = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    return caches / "gaussiandreamer" / "cubins"


def _key(unit: str, target: str) -> str:
    """Return a hash of everything that determines the machine code."""
    texts = [source(unit), *headers(), *headers().values()]
    parts = [*texts, *options_of(unit, target), str(version())]
    return hashlib.sha256("\0".join(parts).encode()).hexdigest()[:24]


def read_cached(name: str) -> Optional[bytes]:
    """Return the content if it is whole: the file ends with a digest of what comes before."""
    try:
        data = (cache_folder() / name).read_bytes()
    except (OSError, RuntimeError):
        return None
    content, digest = data[:-DIGEST], data[-DIGEST:]
    return content if hashlib.sha256(content).digest() == digest else None


def write_cached(name: str, content: bytes) -> None:
    """Write to the cache; log a failure and go on, since kernels can be compiled again."""
    try:
        path = cache_folder() / name
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, content + hashlib.sha256(content).digest())
    except (OSError, RuntimeError, UserError) as error:
        log.warning("compiled CUDA kernels can't be kept for the next start: %s", error)


# ---- the library ---------------------------------------------------------------------------------


@functools.cache
def _library() -> ctypes.CDLL:
    """Load the first candidate that can be loaded."""
    failure = ""
    for candidate in _candidates():
        try:
            library = ctypes.CDLL(candidate)
            library.nvrtcGetErrorString.restype = ctypes.c_char_p
            return library
        except (OSError, AttributeError) as error:  # AttributeError: it is another library
            failure = str(error)
    raise OSError(
        "NVRTC, CUDA's run-time compiler, isn't there: install a CUDA build of torch, or "
        f"nvidia-cuda-nvrtc ({failure})"
    )


def _candidates() -> list[str]:
    """List paths or names to load: only the one in GAUSSIANDREAMER_NVRTC if it is set; otherwise
    those that pip installed, beginning with torch's CUDA release, then those of the system.
    """
    if named := os.environ.get("GAUSSIANDREAMER_NVRTC"):
        return [named]
    release = (torch.version.cuda or "13").split(".")[0]
    pattern = "nvrtc64_*.dll" if sys.platform == "win32" else "libnvrtc*.so*"
    places = (f"cu{release}/lib", "cuda_nvrtc/lib", "cuda_nvrtc/bin", "cu13/lib")
    roots = [sysconfig.get_paths()["purelib"], *sys.path]
    folders = [Path(root, "nvidia", place) for root in roots for place in places]
    folders.insert(0, Path(torch.__file__).parent / "lib")
    if toolkit := os.environ.get("CUDA_HOME"):
        folders.append(Path(toolkit, "lib64"))
    # Path.glob raises for a folder that can't be read
    paths = [path for folder in folders for path in sorted(glob.glob(str(folder / pattern)))]
    found = [path for path in paths if not re.search(r"builtins|\.alt\.", path)]
    return [*dict.fromkeys(found), f"libnvrtc.so.{release}", "libnvrtc.so.12", "libnvrtc.so"]


def _bytes(kind: str, program: ctypes.c_void_p) -> bytes:
    """Return the result of ``nvrtcGet<kind>``."""
    size = ctypes.c_size_t()
    _check(getattr(_library(), f"nvrtcGet{kind}Size")(program, ctypes.byref(size)))
    buffer = ctypes.create_string_buffer(size.value)
    _check(getattr(_library(), f"nvrtcGet{kind}")(program, buffer))
    return buffer.raw


def _strings(texts) -> ctypes.Array:
    return (ctypes.c_char_p * len(texts))(*(text.encode() for text in texts))


def _check(status: int) -> None:
    if status:
        raise UserError(f"NVRTC failed: {_error(status)}")


def _error(status: int) -> str:
    return _library().nvrtcGetErrorString(status).decode()
