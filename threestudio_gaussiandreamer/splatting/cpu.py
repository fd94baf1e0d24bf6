"""The native CPU backend: three builds of one C++ source, called through ctypes.

The library is built by ``pip install`` (see ``setup.py``) once per instruction set: v4 (AVX-512, 16 lanes), v3 (AVX2, 8 lanes)
and base (4 lanes, any processor). The best one for this machine is loaded; the environment variable GAUSSIANDREAMER_ISA forces
one. It uses as many threads as torch does. Kernels blend three channels; more are drawn three at a time.
"""

import ctypes
import functools
import os
import pathlib
from typing import NamedTuple, Optional

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..errors import UserError, unknown
from .options import RasterizeOptions
from .output import Rasterized

FOLDER = pathlib.Path(__file__).parent / "native"
BUILDS = ("v4", "v3", "base")  # best first
CHANNELS = 3
SMALLEST_ALPHA = 2.0**-100  # stands for alpha_min = 0: below it a float32 image can't tell


def unavailable() -> Optional[str]:
    """Why the library can't be used on this machine, or None."""
    try:
        _library()
    except (OSError, UserError) as error:
        return str(error)


def rasterize(means, quats, scales, opacities, colors, viewmats, Ks, width, height, background, options: RasterizeOptions) -> Rasterized:
    """All views; arguments as in `splatting.rasterize`, already validated."""
    views, channels = len(viewmats), colors.shape[-1]
    if background is None:
        background = means.new_zeros(views, channels)
    gaussians = (means, quats, scales, opacities)
    tracked = torch.is_grad_enabled() and any(x.requires_grad for x in (*gaussians, colors, viewmats, background))
    means2d = means.new_zeros(views, len(means), 2).requires_grad_(tracked)
    frame = Frame(width, height, options, tracked, torch.get_num_threads())
    pictures = [
        _Rasterize.apply(*gaussians, colors[..., c : c + CHANNELS], viewmats, background[:, c : c + CHANNELS], means2d, Ks, frame)
        for c in range(0, channels, CHANNELS)
    ]
    image = pictures[0][0] if channels == CHANNELS else torch.cat([picture[0] for picture in pictures], -1)
    return Rasterized(image, *pictures[0][1:3], means2d, *pictures[0][3:])


class Frame(NamedTuple):
    """What a call is told besides tensors."""

    width: int
    height: int
    options: RasterizeOptions
    tracked: bool
    threads: int


class _Rasterize(torch.autograd.Function):
    """Three channels. ``means2d`` is filled in place and takes part as an input, so that autograd hands it its gradient."""

    @staticmethod
    def forward(ctx, means, quats, scales, opacities, colors, viewmats, background, means2d, Ks, frame):
        inputs = (means, quats, scales, opacities, _three(colors), viewmats, _three(background), Ks)
        options = frame.options
        size = (len(viewmats), frame.height // options.downsample, frame.width // options.downsample)
        image, alpha, depth = (means.new_empty(*size, channels) for channels in (CHANNELS, 1, 1))
        radii, contribution = (means.new_empty(size[0], len(means)) for _ in range(2))
        pictures = _Pictures(*map(_pointer, (image, alpha, depth, means2d, radii, contribution)))
        handle = ctypes.c_void_p()
        _check(_library().splat_forward(_scene(inputs, frame), _settings(frame), pictures, ctypes.byref(handle) if frame.tracked else None))
        ctx.state, ctx.frame, ctx.means2d = _State(handle) if frame.tracked else None, frame, means2d
        ctx.save_for_backward(*inputs)
        ctx.mark_non_differentiable(radii, contribution)
        return image[..., : colors.shape[-1]], alpha, depth, radii, contribution

    @staticmethod
    @once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth, *_):
        inputs, frame = ctx.saved_tensors, ctx.frame
        means, quats, scales, opacities, colors, viewmats, background, _ = inputs
        channels = d_image.shape[-1]
        upstream = tuple(x.contiguous() for x in (_three(d_image), d_alpha, d_depth))
        d_viewmats = torch.empty_like(viewmats) if ctx.needs_input_grad[5] else None
        absgrad = torch.empty_like(ctx.means2d) if frame.options.absgrad else None
        grads = [*map(torch.empty_like, (means, quats, scales, opacities, colors, background)), d_viewmats, torch.empty_like(ctx.means2d)]
        gradients = _Gradients(*map(_pointer, (*grads, absgrad)))
        _check(_library().splat_backward(ctx.state.handle, _scene(inputs, frame), _settings(frame), _Upstream(*map(_pointer, upstream)), gradients))
        if absgrad is not None:
            ctx.means2d.absgrad = absgrad + getattr(ctx.means2d, "absgrad", 0)
        d_means, d_quats, d_scales, d_opacities, d_colors, d_background, _, d_means2d = grads
        d_colors, d_background = d_colors[..., :channels], d_background[..., :channels]
        return d_means, d_quats, d_scales, d_opacities, d_colors, d_viewmats, d_background, d_means2d, None, None


def _three(x: Tensor) -> Tensor:
    """Contiguous, with zeros for the channels that are missing."""
    missing = CHANNELS - x.shape[-1]
    return torch.nn.functional.pad(x, (0, missing)) if missing else x.contiguous()


# ---- the C interface: native/scene.h -------------------------------------------------------------------------------------------


class _Scene(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in "means quats scales opacities colors viewmats background Ks".split()]
    _fields_ += [("gaussians", ctypes.c_int64)] + [(name, ctypes.c_int32) for name in "views width height colors_per_view".split()]


class _Settings(ctypes.Structure):
    _fields_ = [(name, ctypes.c_float) for name in "near far eps2d alpha_min alpha_max stop".split()]
    _fields_ += [(name, ctypes.c_int32) for name in "antialias downsample threads".split()]


class _Pictures(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in "image alpha depth means2d radii contribution".split()]


class _Upstream(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in "image alpha depth".split()]


class _Gradients(ctypes.Structure):
    _fields_ = [(name, ctypes.c_void_p) for name in "means quats scales opacities colors background viewmats means2d absgrad".split()]


class _State:
    """Owns what a backward pass needs from its forward pass, for as long as autograd may ask for it."""

    def __init__(self, handle: ctypes.c_void_p):
        self.handle = handle
        self.release = _library().splat_release

    def __del__(self):
        self.release(self.handle)


def _scene(inputs: tuple[Tensor, ...], frame: Frame) -> _Scene:
    means, colors, viewmats = inputs[0], inputs[4], inputs[5]
    return _Scene(*map(_pointer, inputs[:8]), len(means), len(viewmats), frame.width, frame.height, colors.dim() == 3)


def _settings(frame: Frame) -> _Settings:
    o = frame.options
    alpha_min = max(o.alpha_min, SMALLEST_ALPHA)
    return _Settings(o.near, o.far, o.eps2d, alpha_min, o.alpha_max, o.stop, o.antialias, o.downsample, frame.threads)


def _pointer(tensor: Optional[Tensor]) -> Optional[int]:
    return None if tensor is None else tensor.data_ptr()


def _check(needed: int) -> None:
    if needed:
        size = f"{needed / 2**30:.1f} GiB" if needed > 0 else "more memory than there is"
        raise UserError(f"these Gaussians cover so many tiles that drawing them needs {size}: use fewer views per call, fewer or smaller Gaussians.")


@functools.lru_cache(maxsize=None)
def _library() -> ctypes.CDLL:
    """The build that GAUSSIANDREAMER_ISA names, else the best one that exists and that this processor runs."""
    forced = os.environ.get("GAUSSIANDREAMER_ISA")
    if forced and forced not in BUILDS:
        raise unknown("instruction set in GAUSSIANDREAMER_ISA", forced, BUILDS)
    if not _path("base").exists():
        raise OSError("the kernel library isn't built: install the package with a C++ compiler at hand (g++ 9 or later)")
    best = _load("base").splat_best_isa().decode()
    usable = [name for name in BUILDS[BUILDS.index(best) :] if _path(name).exists()]
    if forced and forced not in usable:
        raise UserError(f"GAUSSIANDREAMER_ISA={forced}, but this machine and installation only have {', '.join(usable)}.")
    return _load(forced or usable[0])


def _path(build: str) -> pathlib.Path:
    return FOLDER / f"libsplat_{build}.so"


def _load(build: str) -> ctypes.CDLL:
    library = ctypes.CDLL(str(_path(build)))
    library.splat_forward.restype = library.splat_backward.restype = ctypes.c_int64
    library.splat_forward.argtypes = [ctypes.POINTER(_Scene), ctypes.POINTER(_Settings), ctypes.POINTER(_Pictures), ctypes.POINTER(ctypes.c_void_p)]
    library.splat_backward.argtypes = [ctypes.c_void_p, *map(ctypes.POINTER, (_Scene, _Settings, _Upstream, _Gradients))]
    library.splat_release.argtypes = [ctypes.c_void_p]
    library.splat_best_isa.restype = ctypes.c_char_p
    return library
