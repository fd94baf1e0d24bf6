"""Builds the native splatting library, once per instruction set; everything else is in
pyproject.toml.

The library is plain C++ behind a C interface: neither Python's headers nor torch are needed.
Without a C++ compiler, or with one that doesn't know an instruction set, the package installs all
the same and draws with what there is."""

import os
import platform
from pathlib import Path

from setuptools import Extension, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build_ext import build_ext

PACKAGE = "threestudio_gaussiandreamer.splatting.cpu"
NATIVE = Path(*PACKAGE.split("."))
SHARED = NATIVE.parent / "shared"
# Not -ffast-math: linking with it makes the whole process flush denormals. -fno-wrapv undoes the
# -fwrapv of Python's own flags, with which the kernel takes a thirtieth more time.
FLAGS = (
    "-std=c++17 -O3 -g0 -fno-wrapv -fno-math-errno -fno-trapping-math "
    "-ffp-contract=fast -fvisibility=hidden -pthread"
).split()
X86_BUILDS = {
    "v4": ["-march=x86-64-v4", "-mprefer-vector-width=512"],
    "v3": ["-march=x86-64-v3"],
    "base": ["-Wno-psabi"],
}


def extensions() -> list[Extension]:
    """One shared library per instruction set that this kind of processor may have."""
    builds = X86_BUILDS if platform.machine() in ("x86_64", "AMD64") else {"base": []}
    return [
        Extension(
            f"{PACKAGE}.libsplat_{name}",
            sources=[str(NATIVE / "rasterize.cpp")],
            include_dirs=[str(SHARED)],
            depends=sorted(map(str, (*NATIVE.glob("*.h"), *SHARED.glob("*.h")))),
            extra_compile_args=FLAGS + flags,
            extra_link_args=["-pthread"],
            language="c++",
            optional=True,
        )
        for name, flags in builds.items()
    ]


class BuildLibraries(build_ext):
    """Compiles the builds side by side and names them plainly, since ctypes loads them and not
    Python's import.
    """

    def finalize_options(self):
        super().finalize_options()
        self.parallel = self.parallel or len(X86_BUILDS)

    def build_extension(self, extension):
        """One folder of objects per build: they all come from the same source."""
        folder = os.path.join(self.build_temp, extension.name)
        flags = {
            "extra_postargs": extension.extra_compile_args,
            "depends": extension.depends,
            "include_dirs": extension.include_dirs,
        }
        objects = self.compiler.compile(extension.sources, output_dir=folder, **flags)
        library = self.get_ext_fullpath(extension.name)
        self.compiler.link_shared_object(
            objects, library, extra_postargs=extension.extra_link_args, target_lang="c++"
        )

    def get_ext_filename(self, fullname):
        return os.path.join(*fullname.split(".")) + ".so"


class PlatformWheel(bdist_wheel):
    """A wheel for any Python 3 of one platform: the libraries don't use Python's own interface."""

    def get_tag(self):
        return ("py3", "none", super().get_tag()[2])


setup(
    ext_modules=extensions(),
    cmdclass={"build_ext": BuildLibraries, "bdist_wheel": PlatformWheel},
)
