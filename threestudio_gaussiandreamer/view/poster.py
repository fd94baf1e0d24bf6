"""Still and moving pictures of a cloud with a transparent background."""

from typing import Any

import torch

from ..formats.gaussian_files import StoredCloud
from .render import Pose, RenderSettings, render


def picture(cloud: StoredCloud, settings: RenderSettings, pose: Pose, size: int) -> Any:
    """Render one view as a Pillow image RGBA, ``size`` pixels each way."""
    from PIL import Image

    view = render(cloud, settings, [pose], size)[0]
    alpha = view[..., 3:]
    # files hold colours that aren't multiplied by alpha
    straight = torch.cat([view[..., :3] / alpha.clamp_min(1e-6), alpha], -1)
    return Image.fromarray((255 * straight.clamp(0, 1)).round().byte().numpy(), "RGBA")
