"""What the options of ``exact-score-guidance`` must fulfil together."""

from typing import Any

from ..core.errors import UserError
from .variants.base import require_unset

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
