"""The native CPU backend: three builds of one C++ source, called through ctypes.

The library is built by ``pip install`` (see ``setup.py``) once per instruction set: v4 (AVX-512, 16
lanes), v3 (AVX2, 8 lanes) and base (4 lanes, any processor). The best one for this machine is
loaded; the environment variable GAUSSIANDREAMER_ISA forces one. It uses as many threads as torch
does. Kernels blend three channels; other numbers are drawn three at a time."""

import ctypes
import functools
import os
import pathlib
from collections.abc import Sequence
from typing import NamedTuple, Optional

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ...core.errors import UserError, unknown
from .. import torch_backend
from ..channels import CHANNELS, groups, narrow, widen
from ..options import RasterizeOptions
from ..output import Rasterized

FOLDER = pathlib.Path(__file__).parent
BUILDS = ("v4", "v3", "base")  # best first
VIEWMATS = 4  # among the inputs of the kernel


def unavailable() -> Optional[str]:
    """Why the library can't be used on this machine, or None."""
    try:
        _library()
    except (OSError, UserError) as error:
        return str(error)


def rasterize(
    means,
    quats,
    scales,
    opacities,
    colors,
    viewmats,
    Ks,
    width,
    height,
    background,
    options: RasterizeOptions,
) -> Rasterized:
    """All views; arguments as in `splatting.rasterize`, already validated."""
    views, channels = len(viewmats), colors.shape[-1]
    if channels > CHANNELS and options.absgrad:
        # A sum of absolute values doesn't split into groups of channels.
        return torch_backend.rasterize(
            means,
            quats,
            scales,
            opacities,
            colors,
            viewmats,
            Ks,
            width,
            height,
            background,
            options,
        )
    if background is None:
        background = means.new_zeros(views, channels)
    inputs = (means, quats, scales, opacities, viewmats)
    tracked = torch.is_grad_enabled() and any(
        x.requires_grad for x in (*inputs, colors, background)
    )
    means2d = means.new_zeros(views, len(means), 2).requires_grad_(tracked)
    if tracked and options.absgrad:
        means2d.absgrad = torch.zeros_like(means2d, requires_grad=False)
    frame = Frame(width, height, options, tracked, torch.get_num_threads(), _library())
    drawn = [
        _Rasterize.apply(*inputs, *group, means2d, Ks, frame)
        for group in groups(colors, background)
    ]
    image = drawn[0][0] if channels <= CHANNELS else torch.cat([group[0] for group in drawn], -1)
    _, alpha, depth, radii, contribution = drawn[0]
    return Rasterized(image, alpha, depth, means2d, radii, contribution)


class Frame(NamedTuple):
    """What a call is told besides tensors."""

    width: int
    height: int
    options: RasterizeOptions
    tracked: bool
    threads: int
    library: ctypes.CDLL


class _Rasterize(torch.autograd.Function):
    """Up to three channels. ``means2d`` is filled in place, and is an input so that autograd hands
    it its gradient.
    """

    @staticmethod
    def forward(
        ctx, means, quats, scales, opacities, viewmats, colors, background, means2d, Ks, frame
    ):
        inputs = (means, quats, scales, opacities, viewmats, widen(colors), widen(background), Ks)
        (image, alpha, depth, radii, contribution), state = _draw(inputs, means2d, frame)
        ctx.frame, ctx.means2d, ctx.channels = frame, means2d, colors.shape[-1]
        ctx.save_for_backward(*inputs, state.as_tensor())
        ctx.set_materialize_grads(False)
        ctx.mark_non_differentiable(radii, contribution)
        return narrow(image, ctx.channels), alpha, depth, radii, contribution

    @staticmethod
    @once_differentiable
    def backward(ctx, d_image, d_alpha, d_depth, *_):
        *inputs, saved = ctx.saved_tensors
        state = getattr(saved, "owner", None)
        if state is None:  # hooks on saved tensors (checkpointing, offloading) hand back other ones
            _, state = _draw(inputs, ctx.means2d, ctx.frame)
        upstream = (None if d_image is None else widen(d_image), d_alpha, d_depth)
        grads, d_means2d, absgrad = _draw_vjp(
            state, inputs, upstream, ctx.means2d, ctx.frame, ctx.needs_input_grad[VIEWMATS]
        )
        if absgrad is not None:
            ctx.means2d.absgrad += absgrad
        *grads, d_colors, d_background = grads
        return (
            *grads,
            narrow(d_colors, ctx.channels),
            narrow(d_background, ctx.channels),
            d_means2d,
            None,
            None,
        )


def _draw(
    inputs: Sequence[Tensor], means2d: Tensor, frame: Frame
) -> tuple[tuple[Tensor, ...], "_State"]:
    """Image, alpha, depth, radii and contribution, and what `_draw_vjp` needs; fills
    ``means2d``.
    """
    means, views, scale = inputs[0], len(means2d), frame.options.downsample
    size = (views, frame.height // scale, frame.width // scale)
    pictures = [means.new_empty(*size, channels) for channels in (CHANNELS, 1, 1)]
    per_gaussian = [means.new_empty(views, len(means)) for _ in range(2)]
    handle = ctypes.c_void_p()
    keep = ctypes.byref(handle) if frame.tracked else None
    out = _Pictures(*map(_pointer, (*pictures, means2d, *per_gaussian)))
    _check(frame.library.splat_forward(_scene(inputs, frame), _settings(frame), out, keep))
    return (*pictures, *per_gaussian), _State(frame.library, handle)


def _draw_vjp(
    state: "_State",
    inputs: Sequence[Tensor],
    upstream,
    means2d: Tensor,
    frame: Frame,
    of_viewmats: bool,
):
    """Gradients of ``inputs`` but for the last, of ``means2d``, and ``absgrad``; None for those
    that nobody wants.
    """
    grads = [torch.empty_like(x) for x in inputs[:-1]]
    if not of_viewmats:
        grads[VIEWMATS] = None
    d_means2d, absgrad = (
        torch.empty_like(means2d),
        torch.empty_like(means2d) if frame.options.absgrad else None,
    )
    upstream = [None if d is None else d.contiguous() for d in upstream]
    out = _Gradients(*map(_pointer, (*grads, d_means2d, absgrad)))
    _check(
        state.library.splat_backward(
            state.handle,
            _scene(inputs, frame),
            _settings(frame),
            _Upstream(*map(_pointer, upstream)),
            out,
        )
    )
    return grads, d_means2d, absgrad


# ---- the C interface: scene.h --------------------------------------------------------------------


class _Scene(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p)
        for name in "means quats scales opacities viewmats colors background Ks".split()
    ]
    _fields_ += [("gaussians", ctypes.c_int64)] + [
        (name, ctypes.c_int32) for name in "views width height colors_per_view".split()
    ]


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
    _fields_ = [(name, ctypes.c_void_p) for name in "image alpha depth".split()]


class _Gradients(ctypes.Structure):
    _fields_ = [
        (name, ctypes.c_void_p)
        for name in (
            "means quats scales opacities viewmats colors background means2d absgrad"
        ).split()
    ]


class _State:
    """Owns what a backward pass needs from its forward pass."""

    def __init__(self, library: ctypes.CDLL, handle: ctypes.c_void_p):
        self.library, self.handle = library, handle

    def as_tensor(self) -> Tensor:
        """Something to save for backward: autograd lets go of it with the other saved tensors, long
        before the context dies.
        """
        tensor = torch.empty(0)
        tensor.owner = self
        return tensor

    def __del__(self):
        self.library.splat_release(self.handle)


def _scene(inputs: Sequence[Tensor], frame: Frame) -> _Scene:
    means, viewmats, colors = inputs[0], inputs[VIEWMATS], inputs[VIEWMATS + 1]
    return _Scene(
        *map(_pointer, inputs),
        len(means),
        len(viewmats),
        frame.width,
        frame.height,
        colors.dim() == 3,
    )


def _settings(frame: Frame) -> _Settings:
    o = frame.options
    return _Settings(
        o.near,
        o.far,
        o.eps2d,
        o.kernel_alpha_min,
        o.alpha_max,
        o.stop,
        o.antialias,
        o.downsample,
        frame.threads,
    )


def _pointer(tensor: Optional[Tensor]) -> Optional[int]:
    return None if tensor is None else tensor.data_ptr()


def _check(needed: int) -> None:
    if needed:
        size = f"{needed / 2**30:.1f} GiB" if needed > 0 else "more memory than there is"
        raise UserError(
            f"these Gaussians cover so many tiles that drawing them needs {size}: use fewer "
            "views per call, fewer or smaller Gaussians."
        )


def usable_builds() -> list[str]:
    """The builds that are installed and that this processor runs, best first."""
    if not _path("base").exists():
        return []
    best = _load("base").splat_best_isa().decode()
    return [name for name in BUILDS[BUILDS.index(best) :] if _path(name).exists()]


@functools.cache
def _library() -> ctypes.CDLL:
    """The build that GAUSSIANDREAMER_ISA names, else the best one."""
    forced, usable = os.environ.get("GAUSSIANDREAMER_ISA"), usable_builds()
    if forced and forced not in BUILDS:
        raise unknown("instruction set in GAUSSIANDREAMER_ISA", forced, BUILDS)
    if not usable:
        raise OSError(
            "the kernel library isn't built: install the package with a C++ compiler at hand "
            "(g++ 11 or later)"
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
    library = ctypes.CDLL(str(_path(build)))
    library.splat_forward.restype = library.splat_backward.restype = ctypes.c_int64
    library.splat_forward.argtypes = [
        ctypes.POINTER(_Scene),
        ctypes.POINTER(_Settings),
        ctypes.POINTER(_Pictures),
        ctypes.POINTER(ctypes.c_void_p),
    ]
    library.splat_backward.argtypes = [
        ctypes.c_void_p,
        *map(ctypes.POINTER, (_Scene, _Settings, _Upstream, _Gradients)),
    ]
    library.splat_release.argtypes = [ctypes.c_void_p]
    library.splat_best_isa.restype = ctypes.c_char_p
    return library
