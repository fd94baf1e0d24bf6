"""The ground truth of guidances that have one, such as a mesh.

If a guidance has an attribute ``truth`` with the methods of :class:`MeshTruth` (whose ``mesh`` may
be None), renders of the run are compared with it. A guidance that has computed the mean squared
error of a step's renders to the ground truth returns it as ``error_to_truth``; where it doesn't,
steps that are logged render the ground truth.
"""

from collections.abc import Callable
from typing import Any, Optional

import torch
import torch.nn.functional as F
from jaxtyping import Float, UInt8
from torch import Tensor

from ..meshes.raycast import MeshCaster, TargetCache

Batch = dict[str, Any]
Size = tuple[int, int]
"""Height and width, pixels."""


def truth_of(guidance: Any) -> Any:
    """Return the ground truth of a guidance of this or another package; None if it has none."""
    return getattr(guidance, "truth", None)


class MeshTruth:
    """Ray casts a mesh, and caches the pictures of recent cameras.

    Args:
        mesh: casts rays at the mesh.
        supersample: rays per pixel and axis.
        max_cached: largest number of cached pictures, which are stored as uint8.
        prefetch_size: maps (height, width) of a render to the size of the picture that training
            needs for it.
    """

    def __init__(
        self,
        mesh: MeshCaster,
        supersample: int,
        max_cached: int,
        prefetch_size: Callable[[int, int], Size],
    ) -> None:
        self.mesh, self._prefetch_size = mesh, prefetch_size
        self.pictures = TargetCache(mesh, supersample, max_cached)

    @torch.no_grad()
    def render(
        self, batch: Batch, background: Optional[Tensor] = None, *, size: Optional[Size] = None
    ) -> Float[Tensor, "B H W 3"]:
        """Render the ground truth from the views of a batch.

        Args:
            batch: has ``c2w``, ``fovy``, ``height`` and ``width``.
            background: (B, 1, 1, 3) or (B, H, W, 3); None for black.
            size: (height, width) of the pictures, pixels; None for the batch's size.
        """
        height, width = size or (batch["height"], batch["width"])
        rgba = self.pictures(batch["c2w"], batch["fovy"], height, width)
        background = background_of(background, len(rgba), rgba.device)
        return composite(rgba, background).movedim(1, -1)

    @torch.no_grad()
    def prefetch(
        self, c2w: Float[Tensor, "V 4 4"], fovy: Float[Tensor, " V"], height: int, width: int
    ) -> None:
        """Plan to cast these views in large batches, if all fit into the cache. Called if training
        will need most of them at this size.
        """
        if len(c2w) <= self.pictures.capacity:
            self.pictures.plan(c2w, fovy, *self._prefetch_size(height, width))


def background_of(
    background: Optional[Tensor], batch: int, device: torch.device
) -> Float[Tensor, "B bh bw 3"]:
    """Return the background of the renders, detached, or black if it is None."""
    if background is None:
        return torch.zeros(batch, 1, 1, 3, device=device)
    return background.detach().float().expand(batch, -1, -1, -1)


def composite(
    rgba: UInt8[Tensor, "B H W 4"], background: Float[Tensor, "#B bh bw 3"]
) -> Float[Tensor, "B 3 H W"]:
    """Composite premultiplied pictures over the background, which is resized to their size."""
    background = background.movedim(-1, 1)
    if background.shape[-2:] != (1, 1):
        background = resized(background, tuple(rgba.shape[1:3]))
    rgba = rgba.movedim(-1, 1).contiguous().to(background).div_(255)
    return ((1 - rgba[:, 3:]) * background).add_(rgba[:, :3])


def resized(images: Float[Tensor, "B c H W"], size: tuple[int, int]) -> Float[Tensor, "B c h w"]:
    """Resize images: average blocks if the sizes divide evenly, else bilinear with antialiasing."""
    height, width = images.shape[-2:]
    if (height, width) == size:
        return images
    if height % size[0] == 0 and width % size[1] == 0:
        return F.avg_pool2d(images, (height // size[0], width // size[1]))
    return F.interpolate(images, size, mode="bilinear", align_corners=False, antialias=True)
