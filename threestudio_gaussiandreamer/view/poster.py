"""Pictures of a cloud with a transparent background, and a colour that suits them as one."""

from pathlib import Path
from typing import Any, Optional

import numpy as np
import torch

from ..formats.gaussian_files import StoredCloud
from .render import Pose, RenderSettings, render

Color = tuple[float, float, float]
"""RGB in [0, 1]."""
WHITE: Color = (1.0, 1.0, 1.0)
BACKDROPS: tuple[Color, ...] = (WHITE, (0.5, 0.5, 0.5), (0.125, 0.125, 0.125))
LEAST_CONTRAST, OUTLINE_SHARE = 0.15, 0.25
"""An object vanishes on a colour from which this share of its outline differs less in RGB."""


def picture(cloud: StoredCloud, settings: RenderSettings, pose: Pose, size: int) -> Any:
    """Render one view as a Pillow image RGBA, ``size`` pixels each way."""
    from PIL import Image

    view = render(cloud, settings, [pose], size)[0]
    alpha = view[..., 3:]
    # files hold colours that aren't multiplied by alpha
    straight = torch.cat([view[..., :3] / alpha.clamp_min(1e-6), alpha], -1)
    return Image.fromarray((255 * straight.clamp(0, 1)).round().byte().numpy(), "RGBA")


def backdrop(image: Any, wanted: Color) -> Color:
    """Return ``wanted``, or the one of ``BACKDROPS`` with the most contrast if the object of a
    Pillow image RGBA would vanish on it.
    """
    pixels = np.asarray(image) / 255
    opaque = pixels[..., 3] > 0.5
    moved = [np.roll(opaque, step, axis) for axis in (0, 1) for step in (-1, 1)]
    outline = pixels[opaque & ~np.logical_and.reduce(moved)][:, :3]
    if not len(outline):
        return wanted

    def contrast(color: Color) -> float:
        return float(np.quantile(np.abs(outline - color).max(1), OUTLINE_SHARE))

    return wanted if contrast(wanted) >= LEAST_CONTRAST else max(BACKDROPS, key=contrast)


def backdrop_of_file(path: Path) -> Optional[Color]:
    """Return the backdrop on a white page of a picture; None if it is opaque or can't be read."""
    from PIL import Image

    try:
        image = Image.open(path)
        return backdrop(image, WHITE) if image.mode == "RGBA" else None
    except Exception:  # Pillow raises many kinds for damaged files
        return None


def hex_color(color: Color) -> str:
    """Return a colour as #rrggbb."""
    return "#" + bytes(round(255 * x) for x in color).hex()
