"""The CPU kernel's build of 16 lanes for processors without AVX-512: its intrinsics are emulated,
and all else is the package's source.
"""

import functools
import shutil
import subprocess
import tempfile
from pathlib import Path

from threestudio_gaussiandreamer.splatting.cpu import backend

HEADER = Path(__file__).with_suffix(".h")
FLAGS = (
    "-std=c++17 -O1 -march=x86-64-v3 -fPIC -shared -pthread -fvisibility=hidden "
    "-ffp-contract=off -fno-math-errno -fno-trapping-math -Wno-psabi"
).split()


def is_needed() -> bool:
    """Return whether this processor can run the emulated build but not the real one."""
    builds = backend.usable_builds()
    return "v3" in builds and "v4" not in builds and shutil.which("g++") is not None


@functools.cache
def folder() -> tempfile.TemporaryDirectory:
    """Compile the library, once per process, into a folder that lives as long as the result."""
    target, source = tempfile.TemporaryDirectory(), backend.FOLDER / "rasterize.cpp"
    includes = ["-include", str(HEADER), f"-I{backend.FOLDER.parent / 'shared'}"]
    library = str(Path(target.name, "libsplat_v4.so"))
    subprocess.run(["g++", *FLAGS, *includes, str(source), "-o", library], check=True)
    return target
