"""Renderer ``gaussiandreamer-splatting``: the host's batch in, the host's pictures out, our
rasteriser between.

==========  ========================================================================================
option      meaning
==========  ========================================================================================
backend     ``auto`` (by where the cloud is and what is built), ``cpu``, ``cuda``, ``torch``,
            ``reference``
preset      ``fast`` | ``balanced`` | ``accurate``: the smallest alpha that is drawn, 1/255, 1/1024,
            1/65536
antialias   keep the energy of Gaussians smaller than a pixel
eps2d       screen-space dilation in square pixels
downsample  1, or 2: return the 2x2 box of the rendered size (the paper renders 1024^2 and guides at
            512^2)
==========  ========================================================================================
"""

from collections import UserDict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from typing import Any, ClassVar

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor

from .. import cameras
from ..core.devices import get_device, without_autocast
from ..core.errors import UserError
from ..core.options import RULE, at_least, in_range, one_of, positive
from ..gaussians.gaussians import require_attributes
from ..host import Rasterizer, register
from ..splatting import PRESETS, Rasterized, rasterize
from ..splatting.backends import choose_backend
from .background import FlatBackground


def check_backend(option: str, name: str) -> None:
    """Raise UserError, which names the option's path, unless the backend exists and runs here."""
    try:
        if name != "auto":
            choose_backend(name, torch.empty(0, device=get_device()))
    except UserError as error:
        raise UserError(f"{option}: {error}") from error


DRAWING = ("eps2d", "antialias", "preset", "downsample", "backend")
"""Options that `rasterize` is given."""


@register("gaussiandreamer-splatting")
class SplattingRenderer(Rasterizer):
    @dataclass
    class Config(Rasterizer.Config):
        radius: float = field(default=1.0, metadata=positive())
        backend: str = field(default="auto", metadata={RULE: check_backend})
        preset: str = field(default="balanced", metadata=one_of(PRESETS))
        antialias: bool = False
        eps2d: float = field(default=0.3, metadata=at_least(0, "square pixels"))
        downsample: int = field(default=1, metadata=in_range(1, 2))

        REMOVED: ClassVar[dict[str, Any]] = {
            "near": (0.01, "it is 0.01 world units"),
            "far": (1e10, "there is no far plane"),
        }

    cfg: Config

    def configure(self, geometry: Any, material: Any, background: Any) -> None:
        require_attributes(geometry, ("means", "quats", "scales", "opacities", "colors"))
        super().configure(geometry, material, background)

    def forward(
        self, c2w: Tensor, fovy: Tensor, height: int, width: int, **unused: Any
    ) -> "LazyMapping":
        """Render B views, in float32 whatever the trainer's precision is: half would move cameras.

        Args:
            c2w: (B, 4, 4) OpenGL.
            fovy: (B,) radians.
            height, width: pixels, before ``downsample``.

        Returns:
            ``comp_rgb`` (B, H, W, 3), ``opacity`` and ``depth`` (B, H, W, 1), ``comp_normal``
            (B, H, W, 3) in [0, 1], ``comp_rgb_bg``, the background, (B, 1, 1, 3) or (B, H, W, 3),
            ``rasterized`` for density control, and ``gaussian_opacities`` (N,), which the removal
            error is differentiated by. Depth and normals are computed when they are first read.
        """
        cloud, device = self.geometry, self.geometry.means.device
        c2w, fovy = c2w.to(device, torch.float32), fovy.to(device, torch.float32)
        with without_autocast(device.type):
            flat = FlatBackground.is_flat(self.background)
            color = self.background.color(len(c2w)) if flat else None
            opacities = cloud.opacities()
            viewmats, Ks = cameras.to_opencv(c2w, fovy, height, width)
            colors = cloud.colors(c2w[:, :3, 3])
            out = rasterize(
                *(cloud.means, cloud.quats, cloud.scales(), opacities, colors),
                *(viewmats, Ks, width, height),
                background=color,
                **{name: getattr(self.cfg, name) for name in DRAWING},
                absgrad=self.training and getattr(cloud, "wants_absgrad", False),
            )
            if flat:
                image, background = out.image, color[:, None, None]
            else:
                image, background = self._composite(out, c2w, fovy)
        records = torch.is_grad_enabled()

        def surface(normals: bool) -> Tensor:
            with torch.set_grad_enabled(records), without_autocast(device.type):
                depth = out.depth / out.alpha.clamp_min(1e-6)
                return normals_from_depth(depth, out.alpha, c2w, fovy) if normals else depth

        pictures = {
            "comp_rgb": image,
            "opacity": out.alpha,
            "comp_rgb_bg": background,
            "rasterized": out,
            "gaussian_opacities": opacities,
        }
        later = {"depth": partial(surface, False), "comp_normal": partial(surface, True)}
        return LazyMapping(pictures, later)

    def _composite(self, out: Rasterized, c2w: Tensor, fovy: Tensor) -> tuple[Tensor, Tensor]:
        """Composite over another extension's background, which takes a direction per pixel."""
        rays = cameras.ray_directions(c2w, fovy, *out.image.shape[1:3])
        background, wanted = self.background(rays.to(out.image)), tuple(out.image.shape)
        name, found = type(self.background).__name__, type(background).__name__
        if isinstance(background, Tensor):
            found = f"a tensor {tuple(background.shape)}"
        if getattr(background, "shape", None) != wanted:
            raise UserError(f"{name} returned {found}; expected a tensor of colours {wanted}")
        return out.image + (1 - out.alpha) * background, background


class LazyMapping(UserDict):
    """Values by name; ``later`` are functions of no argument, each called at most once."""

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        self.data, self.later = {**values, **later}, {*later}

    def __getitem__(self, name: str) -> Any:
        if name in self.later:
            self[name] = self.data[name]()
        return self.data[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self.later.discard(name)
        self.data[name] = value


def normals_from_depth(
    depth: Float[Tensor, "B H W 1"],
    alpha: Float[Tensor, "B H W 1"],
    c2w: Float[Tensor, "B 4 4"],
    fovy: Float[Tensor, " B"],
) -> Float[Tensor, "B H W 3"]:
    """Compute world-space normals of the depth surface, mapped from [-1, 1] to [0, 1]; 0.5 where
    nothing is drawn. ``depth`` is along the optical axis.
    """
    focal = cameras.focal_length(fovy, depth.shape[1])
    points = cameras.surface_points(depth[..., 0], c2w, focal)
    padded = F.pad(points, (1, 1, 1, 1), mode="replicate")
    down = padded[:, :, 2:, 1:-1] - padded[:, :, :-2, 1:-1]
    right = padded[:, :, 1:-1, 2:] - padded[:, :, 1:-1, :-2]
    # several times faster than torch.linalg.cross and F.normalize
    normal = down.roll(-1, 1) * right.roll(-2, 1) - down.roll(-2, 1) * right.roll(-1, 1)
    per_length = normal.square().sum(1, keepdim=True).clamp_min(1e-24).rsqrt()
    return 0.5 + (normal * per_length).movedim(1, -1) * (0.5 * (alpha > 0.5))
