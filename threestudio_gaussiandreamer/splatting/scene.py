"""Inputs and outputs of all backends, and the C structs that the compiled kernels take."""

import ctypes
from dataclasses import dataclass
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

TENSORS = 8  # fields of a Scene, before the size of its images
NO_ALPHA_MIN = 2.0**-100
"""Value for compiled kernels if ``alpha_min`` is 0; smaller alphas don't change a float32 image."""


@dataclass(frozen=True)
class RasterizeOptions:
    """Constants of the image model; `splatting.rasterize` documents each one."""

    near: float = 0.01
    far: float = 1e10
    eps2d: float = 0.3
    antialias: bool = False
    alpha_min: float = 1 / 1024
    alpha_max: float = 1 - 2**-10
    stop: float = 1e-4
    downsample: int = 1
    absgrad: bool = False

    @property
    def kernel_alpha_min(self) -> float:
        """Return a positive ``alpha_min``, since compiled kernels take its logarithm."""
        return max(self.alpha_min, 2 * NO_ALPHA_MIN) if self.alpha_min > 0 else NO_ALPHA_MIN

    def struct(self, alpha_min: float, threads: int = 0) -> "Settings":
        """Return the C struct; ``alpha_min`` is as the kernel wants it."""
        limits = (self.near, self.far, self.eps2d, alpha_min, self.alpha_max, self.stop)
        return Settings(*limits, self.antialias, self.downsample, threads)


class Scene(NamedTuple):
    """N Gaussians with C colour channels and B cameras, validated: contiguous tensors on one
    device, all float32, or all float64 for the torch backends. The fields are in the order of the
    struct ``splat::Scene``.
    """

    means: Float[Tensor, "N 3"]
    quats: Float[Tensor, "N 4"]
    scales: Float[Tensor, "N 3"]
    opacities: Float[Tensor, " N"]
    viewmats: Float[Tensor, "B 4 4"]
    colors: Float[Tensor, "*views N C"]
    background: Float[Tensor, "B C"]
    Ks: Float[Tensor, "B 3 3"]
    width: int
    """Of the rendered images, pixels."""
    height: int

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return self[:TENSORS]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height."""
        return self[TENSORS:]

    @property
    def shape(self) -> tuple[int, int]:
        """Views and Gaussians."""
        return self.viewmats.shape[0], self.means.shape[0]  # faster than len

    @property
    def channels(self) -> int:
        return self.colors.shape[-1]

    @property
    def tracked(self) -> bool:
        """Whether anything is differentiated."""
        return torch.is_grad_enabled() and any(x.requires_grad for x in self.tensors)

    def of_views(self, first: int, last: int) -> "Scene":
        """Select the views ``first`` to ``last - 1``."""
        per_view = {name: getattr(self, name)[first:last] for name in ("viewmats", "background")}
        colors = self.colors[first:last] if self.colors.dim() == 3 else self.colors
        return self._replace(colors=colors, Ks=self.Ks[first:last], **per_view)

    def struct(self) -> "SceneStruct":
        """Return the C struct with pointers to the tensors, which must outlive it."""
        views, gaussians = self.shape
        per_view = self.colors.dim() == 3
        return SceneStruct(*pointers(*self.tensors), gaussians, views, *self.size, per_view)


class Rasterized(NamedTuple):
    """B views of N Gaussians with C colour channels, H x W pixels after downsampling."""

    image: Float[Tensor, "B H W C"]
    alpha: Float[Tensor, "B H W 1"]  # in [0, 1]
    depth: Float[Tensor, "B H W 1"]  # sum of t.z alpha_i T_i, world units, not normalised
    # pixels before downsampling; backward fills ``.grad`` and, if asked, ``.absgrad``
    means2d: Float[Tensor, "B N 2"]
    # pixels before downsampling, the larger half extent of alpha >= alpha_min; 0 when culled
    radii: Float[Tensor, "B N"]
    # the largest alpha_i T_i over the pixels of the view; no gradient
    contribution: Float[Tensor, "B N"]


# ---- C structs -----------------------------------------------------------------------------------


class SceneStruct(ctypes.Structure):
    """``splat::Scene`` of shared/splat_scene.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in Scene._fields[:TENSORS]),
        ("gaussians", ctypes.c_longlong),
        *((name, ctypes.c_int) for name in ("views", "width", "height", "colors_per_view")),
    ]


class Settings(ctypes.Structure):
    """``SplatSettings`` of cpu/scene.h; without the last field, ``splat::Settings`` of
    cuda/launch.h, whose ``alpha_min`` is a logarithm.
    """

    _fields_ = [
        *((n, ctypes.c_float) for n in "near far eps2d alpha_min alpha_max stop".split()),
        *((n, ctypes.c_int) for n in "antialias downsample threads".split()),
    ]


def pointers(*tensors: Optional[Tensor]) -> ctypes.Array:
    """Return a C struct of pointers to the tensors' data, null for None; they must outlive it."""
    return (ctypes.c_void_p * len(tensors))(*(None if x is None else x.data_ptr() for x in tensors))
