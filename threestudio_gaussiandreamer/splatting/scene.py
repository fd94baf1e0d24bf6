"""The inputs of a rasterisation, for all backends, and as a C struct for the compiled kernels."""

import ctypes
from typing import NamedTuple, Optional

import torch
from jaxtyping import Float
from torch import Tensor

TENSORS = 8  # fields of a Scene, before the size of its images


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
        per_view = {
            name: getattr(self, name)[first:last] for name in ("viewmats", "background", "Ks")
        }
        colors = self.colors[first:last] if self.colors.dim() == 3 else self.colors
        return self._replace(colors=colors, **per_view)

    def struct(self) -> "SceneStruct":
        """Return the C struct with pointers to the tensors, which must outlive it."""
        views, gaussians = self.shape
        per_view = self.colors.dim() == 3
        return SceneStruct(*map(address, self.tensors), gaussians, views, *self.size, per_view)


class SceneStruct(ctypes.Structure):
    """``splat::Scene`` of shared/splat_scene.h."""

    _fields_ = [
        *((name, ctypes.c_void_p) for name in Scene._fields[:TENSORS]),
        ("gaussians", ctypes.c_longlong),
        *((name, ctypes.c_int) for name in ("views", "width", "height", "colors_per_view")),
    ]


def address(tensor: Optional[Tensor]) -> Optional[int]:
    """Return the address of a tensor's data; None for None."""
    return None if tensor is None else tensor.data_ptr()
