"""What the options of ``exact-score-guidance`` must fulfil together."""

from typing import Any

from ..core.errors import UserError
from .base import is_guided, variant_class
from .variants.base import require_unset

MAX_MODE_BYTES = 2**31
"""Largest memory of a bank in the space of pixels; over backgrounds of pixels, of each item's."""
OF_LATENTS = ("latent_size", "latent_channels", "color_matrix")
OF_BANK = ("bank_views", "bank_includes_view", "bank_elevation_range", "bank_distance_range")
OF_BANK += ("bank_fovy_range",)
"""Without its seed, which series of runs set for all of them."""


def require_used(guidance: type, cfg: Any) -> None:
    """Check that options without effect are unset.

    Raises:
        UserError: ``space: pixel`` with an option of latents, or with one of the bank where no bank
            is cast.
    """
    if cfg.space == "latent":  # whose variance is that of the bank
        return
    require_unset(guidance, cfg, OF_LATENTS, "with space=pixel")
    if cfg.mode == "view-exact" and cfg.guidance_scale == 1:
        reason = "with space=pixel, mode=view-exact and guidance_scale=1, which need no bank"
        require_unset(guidance, cfg, OF_BANK, reason)


def check_render_size(cfg: Any, height: int, width: int) -> None:
    """Check that renders of this size can be compared, see :func:`picture_size`."""
    picture_size(cfg, is_guided(cfg, variant_class(cfg)), height, width)


def picture_size(cfg: Any, guided: bool, height: int, width: int) -> tuple[int, int]:
    """Return the size of the compared pictures for a render of this size: ``image_size`` high, with
    the render's aspect.

    Raises:
        UserError: pictures of that size need too much memory, or can't be pooled to the latent.
    """
    size = cfg.image_size
    height, width = (size, max(1, round(width * size / height))) if size else (height, width)
    if cfg.space == "latent":
        pooling_factor(height, width, cfg.latent_size)
        return height, width
    needed = 12 * cfg.bank_views * height * width
    if (cfg.mode != "view-exact" or guided) and needed > MAX_MODE_BYTES:
        raise UserError(
            f"a bank of {cfg.bank_views} views of {height}x{width} pixels needs "
            f"up to {needed / 2**30:.1f} GiB for each item:"
            " use system.guidance.space=latent, or a smaller system.guidance.image_size"
        )
    return height, width


def pooling_factor(height: int, width: int, latent_size: int) -> int:
    """Return how many pixels each way a latent of this height has.

    Raises:
        UserError: pictures of this size can't be pooled to it.
    """
    factor = height // latent_size
    if factor * latent_size != height or width % max(factor, 1):
        raise UserError(
            f"pictures of {height}x{width} can't be pooled to a latent {latent_size} high: give a "
            "system.guidance.image_size that is a multiple of system.guidance.latent_size"
        )
    return factor
