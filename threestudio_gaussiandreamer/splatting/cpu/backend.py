"""The native CPU backend: three builds of one C++ source, called through ctypes.

The library is built by ``pip install`` (see ``setup.py``) once per instruction set: v4 (AVX-512, 16
lanes), v3 (AVX2, 8 lanes) and base (4 lanes, any processor). The best one that the processor
supports is loaded; the environment variable GAUSSIANDREAMER_ISA selects another. It uses as many
threads as torch does."""

import ctypes
import functools
import os
import pathlib
from typing import NamedTuple, Optional

import torch
from torch import Tensor

from ...core.errors import UserError, unknown
from ...core.memory import main_memory
from .. import autograd
from ..autograd import CHANNELS, Drawn, SceneGradients, Upstream
from ..options import RasterizeOptions
from ..output import Rasterized
from ..scene import Scene, SceneStruct, address

FOLDER = pathlib.Path(__file__).parent
BUILDS = ("v4", "v3", "base")  # best first
INTERFACE = 2  # as in scene.h


def unavailable() -> Optional[str]:
    """Return why the library can't be used on this machine, or None if it can."""
    try:
        library()
    except (OSError, UserError) as error:
        return str(error)


def rasterize(scene: Scene, options: RasterizeOptions) -> Rasterized:
    """Draw all views of a validated scene."""
    kernel = CpuKernel(options, scene.tracked, torch.get_num_threads(), library())
    return autograd.rasterize(kernel, scene, options)


class CpuKernel(NamedTuple):
    """One call of the library; see :class:`..autograd.Kernel`."""

    options: RasterizeOptions
    tracked: bool
    threads: int
    library: ctypes.CDLL

    def forward(self, scene: Scene, means2d: Tensor) -> tuple[Drawn, tuple[Tensor, ...], None]:
        """Render; the only tensor to save is a handle of the library's state."""
        views, gaussians = scene.shape
        new, scale = scene.means.new_empty, self.options.downsample
        size = (views, scene.height // scale, scene.width // scale)
        images = [new(*size, channels) for channels in (CHANNELS, 1, 1)]
        drawn = Drawn(*images, new(views, gaussians), new(views, gaussians))
        handle = ctypes.c_void_p()
        keep = ctypes.byref(handle) if self.tracked else None
        out = _Pictures(*map(address, (*images, means2d, *drawn[3:])))
        _check(self.library.splat_forward(scene.struct(), self._settings(), out, keep))
        return drawn, (_State(self.library, handle).as_tensor(),), None

    def backward(
        self,
        scene: Scene,
        means2d: Tensor,
        saved: tuple[Tensor, ...],
        state: None,
        upstream: Upstream,
        wants_viewmats: bool,
    ) -> SceneGradients:
        """Differentiate; render again if hooks on saved tensors (checkpointing, offloading) have
        replaced the tensor that owns the state.
        """
        saved = saved if hasattr(saved[0], "owner") else self.forward(scene, means2d)[1]
        owner = saved[0].owner
        found = SceneGradients(*map(torch.empty_like, (*scene[:6], means2d)))
        found = found if wants_viewmats else found._replace(viewmats=None)
        absgrad = torch.empty_like(means2d) if self.options.absgrad else None
        out = _Gradients(*map(address, (*found, absgrad)))
        inputs = (scene.struct(), self._settings(), _Upstream(*map(address, upstream)))
        _check(owner.library.splat_backward(owner.handle, *inputs, out))
        if absgrad is not None:
            means2d.absgrad += absgrad
        return found

    def _settings(self) -> "_Settings":
        o, alpha_min = self.options, self.options.kernel_alpha_min
        limits = (o.near, o.far, o.eps2d, alpha_min, o.alpha_max, o.stop)
        return _Settings(*limits, o.antialias, o.downsample, self.threads)


# ---- the C interface: scene.h --------------------------------------------------------------------


class _Settings(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_float) for name in "near far eps2d alpha_min alpha_max stop".split()
    ]
    _fields_ += [(name, ctypes.c_int32) for name in "antialias downsample threads".split()]


class _Pictures(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p) for name in "image alpha depth means2d radii contribution".split()
    ]


class _Upstream(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in Upstream._fields]


class _Gradients(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in (*SceneGradients._fields, "absgrad")]


class _State:
    """Owns what a backward pass needs from its forward pass."""

    def __init__(self, library: ctypes.CDLL, handle: ctypes.c_void_p):
        self.library, self.handle = library, handle

    def as_tensor(self) -> Tensor:
        """Return an empty tensor with a reference to this object, to be saved for backward:
        autograd frees saved tensors right after backward, earlier than the context.
        """
        tensor = torch.empty(0)
        tensor.owner = self
        return tensor

    def __del__(self):
        self.library.splat_release(self.handle)


def _check(needed: int) -> None:
    if needed:
        size = f"{needed / 2**30:.1f} GiB" if needed > 0 else "more memory than there is"
        raise UserError(
            f"these Gaussians cover so many tiles that drawing them needs {size}: use fewer "
            "views per call, fewer or smaller Gaussians."
        )


def usable_builds() -> list[str]:
    """List the installed builds that this processor supports, best first."""
    if not _path("base").exists():
        return []
    best = _load("base").splat_best_isa().decode()
    return [name for name in BUILDS[BUILDS.index(best) :] if _path(name).exists()]


@functools.cache
def library() -> ctypes.CDLL:
    """Load the build that GAUSSIANDREAMER_ISA names, else the best one.

    Raises:
        OSError: it isn't built.
        UserError: this machine or installation doesn't have the named one.
    """
    forced, usable = os.environ.get("GAUSSIANDREAMER_ISA"), usable_builds()
    if forced and forced not in BUILDS:
        raise unknown("instruction set in GAUSSIANDREAMER_ISA", forced, BUILDS)
    if not usable:
        raise OSError(
            "the kernel library isn't built, so plain torch draws: install the package again with "
            "g++ 11 or later or clang at hand (on Windows MinGW-w64 with POSIX threads; "
            "Microsoft's compiler can't build it)"
        )
    if forced and forced not in usable:
        raise UserError(
            f"GAUSSIANDREAMER_ISA={forced}, but this machine and installation only have "
            f"{', '.join(usable)}."
        )
    return _load(forced or usable[0])


def _path(build: str) -> pathlib.Path:
    return FOLDER / f"libsplat_{build}.so"


def _load(build: str) -> ctypes.CDLL:
    return load_library(_path(build))


def load_library(path: pathlib.Path) -> ctypes.CDLL:
    """Load one build and declare its functions.

    Raises:
        OSError: there is no such file, it needs another system library, or it is of an earlier
            version.
    """
    library = ctypes.CDLL(str(path))
    if not hasattr(library, "splat_interface") or library.splat_interface() != INTERFACE:
        raise OSError(f"{path} is of an earlier version: install the package again")
    library.splat_forward.restype = library.splat_backward.restype = ctypes.c_int64
    library.splat_forward.argtypes = [
        ctypes.POINTER(SceneStruct),
        ctypes.POINTER(_Settings),
        ctypes.POINTER(_Pictures),
        ctypes.POINTER(ctypes.c_void_p),
    ]
    library.splat_backward.argtypes = [
        ctypes.c_void_p,
        *map(ctypes.POINTER, (SceneStruct, _Settings, _Upstream, _Gradients)),
    ]
    library.splat_release.argtypes = [ctypes.c_void_p]
    library.splat_best_isa.restype = ctypes.c_char_p
    library.splat_set_memory.argtypes = [ctypes.c_int64]
    library.splat_set_memory.restype = None
    library.splat_set_memory(main_memory())
    return library
