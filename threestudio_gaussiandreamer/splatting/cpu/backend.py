"""The native CPU backend: three builds of one C++ source, called through ctypes.

The library is built by ``pip install`` (see ``setup.py``) once per instruction set: v4 (AVX-512, 16
lanes), v3 (AVX2, 8 lanes) and base (4 lanes, any processor). The best one that the processor
supports is loaded; the environment variable GAUSSIANDREAMER_ISA selects another. It uses as many
threads as torch does."""

import ctypes
import functools
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float, UInt8
from torch import Tensor

from ...core.errors import UserError
from ...core.options import main_memory
from .. import autograd
from ..autograd import Drawn, SceneGradients, Upstream
from ..scene import Rasterized, RasterizeOptions, Scene, SceneStruct, Settings, pointers

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
    settings = options.struct(options.kernel_alpha_min, torch.get_num_threads())
    return autograd.rasterize(CpuKernel(library(), settings, scene.tracked), scene, options)


class CpuKernel(NamedTuple):
    """One call of the library; see ``autograd.py``. The structs are those of scene.h."""

    library: ctypes.CDLL
    settings: Settings
    tracked: bool

    def forward(self, scene: Scene, means2d: Tensor, out: Drawn) -> tuple[tuple[Tensor, ...], None]:
        """Render. The tensor to save refers to the library's state: autograd frees saved tensors
        right after backward, earlier than the context.
        """
        kept = torch.empty(0)
        kept.state = _State(self.library)
        keep = ctypes.byref(kept.state.handle) if self.tracked else None
        pictures = pointers(*out[:3], means2d, *out[3:])
        _check(self.library.splat_forward(scene.struct(), self.settings, pictures, keep))
        return (kept,), None

    def backward(
        self,
        scene: Scene,
        means2d: Tensor,
        saved: Sequence[Tensor],
        _: None,
        upstream: Upstream,
        out: SceneGradients,
    ) -> None:
        """Differentiate; render again if hooks on saved tensors (checkpointing, offloading) have
        replaced the tensor that refers to the state.
        """
        if not hasattr(saved[0], "state"):
            saved, _ = self.forward(scene, means2d, Drawn.empty(scene, self.settings.downsample))
        absgrad = torch.empty_like(means2d) if hasattr(means2d, "absgrad") else None
        inputs = saved[0].state.handle, scene.struct(), self.settings, pointers(*upstream)
        _check(self.library.splat_backward(*inputs, pointers(*out, absgrad)))
        if absgrad is not None:
            means2d.absgrad += absgrad


class _State:
    """Owns what a backward pass needs from its forward pass."""

    def __init__(self, library: ctypes.CDLL):
        self.library, self.handle = library, ctypes.c_void_p()

    def __del__(self):
        self.library.splat_release(self.handle)


def _check(needed: int) -> None:
    if needed:
        size = f"{needed / 2**30:.1f} GiB" if needed > 0 else "more memory than there is"
        raise UserError(
            f"these Gaussians cover so many tiles that drawing them needs {size}: use fewer "
            "views per call, fewer or smaller Gaussians."
        )


# ---- score distillation towards one known picture per render -------------------------------------


class _KnownPictures(ctypes.Structure):
    """``SplatKnownPictures`` of scene.h."""

    _fields_ = [
        *((n, ctypes.c_void_p) for n in "render pictures background scale weight".split()),
        *((n, ctypes.c_int64) for n in "items height width".split()),
        ("threads", ctypes.c_int32),
        ("slope", ctypes.c_float),
    ]


def known_gradient(
    render: Float[Tensor, "B H W 3"],
    pictures: Sequence[UInt8[Tensor, "4 H W"]],
    background: Float[Tensor, "B 3"],
    scale: Float[Tensor, " B"],
    weight: Float[Tensor, " B"],
) -> Optional[tuple[Float[Tensor, "B H W 3"], Float[Tensor, " B"]]]:
    """Compute, on a CPU with the library, the gradient of the loss 0.5 sum g^2 / B with respect to
    the renders, where
    g = w s (x - x_1) is the gradient of score distillation with respect to the latent
    x = 2 render - 1, and x_1 the latent of a picture on the background.

    Args:
        pictures: one per render, premultiplied.
        scale: s, of the error of the latent.
        weight: w.

    Returns:
        the gradient, 2 g / B, bit for bit that of plain torch, and the sum of g^2 per item,
        float64; None for tensors that the library doesn't take.
    """
    float32 = (render, background, scale, weight)
    taken = all(x.dtype == torch.float32 and x.is_contiguous() for x in float32)
    taken = taken and all(picture.is_contiguous() for picture in pictures)
    if not taken:
        return None
    items, height, width, _ = render.shape
    gradient = torch.empty_like(render)
    squares = torch.empty(items, height, dtype=torch.float64)
    planes = pointers(*pictures)
    addresses = pointers(render, None, background, scale, weight)
    addresses[1] = ctypes.addressof(planes)
    rest = (items, height, width, torch.get_num_threads(), 2 / max(items, 1))
    known = _KnownPictures(*addresses, *rest)
    failed = library().splat_gradients_to_pictures(known, pointers(gradient, squares))
    return None if failed else (gradient, squares.sum(1))  # out of memory


# ---- the library ---------------------------------------------------------------------------------


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
    """Load one build and declare its functions; OSError if it is missing or unfit."""
    path, struct = _path(build), ctypes.c_void_p
    library, scene, settings = ctypes.CDLL(str(path)), *map(ctypes.POINTER, (SceneStruct, Settings))
    known = hasattr(library, "splat_gradients_to_pictures")  # added last
    if not known or library.splat_interface() != INTERFACE:
        raise OSError(f"{path} is of an earlier version: install the package again")
    for name, result, *arguments in (
        ("forward", ctypes.c_int64, scene, settings, struct, ctypes.POINTER(struct)),
        ("backward", ctypes.c_int64, struct, scene, settings, struct, struct),
        ("release", None, struct),
        ("best_isa", ctypes.c_char_p),
        ("set_memory", None, ctypes.c_int64),
        ("gradients_to_pictures", ctypes.c_int64, ctypes.POINTER(_KnownPictures), struct),
    ):
        function = getattr(library, f"splat_{name}")
        function.restype, function.argtypes = result, arguments
    library.splat_set_memory(main_memory())
    return library
