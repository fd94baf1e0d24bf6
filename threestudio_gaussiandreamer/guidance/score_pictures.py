"""Pictures of the score model's inputs and predictions, for the host's
``guidance_evaluation_save`` and for validation.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..diffusion import sds

if TYPE_CHECKING:
    from .base import ScoreDistillation


class Noised(NamedTuple):
    """A batch of noisy latents, the input of the score model."""

    t: Int[Tensor, " B"]
    abar: Float[Tensor, " B"]
    """float64."""
    noise: Float[Tensor, "B c h w"]
    z: Float[Tensor, "B c h w"]


@torch.no_grad()
def score_pictures(
    guidance: "ScoreDistillation", noised: Noised, prompt_utils: Any, batch: dict[str, Any]
) -> dict[str, Any]:
    """Decode the noisy latents and the predictions of the score model.

    Returns:
        pictures (B, H, W, 3) in [0, 1]: ``imgs_noisy``, the noisy latents; ``imgs_1step``,
        denoised in one step with guidance; ``imgs_1orig``, denoised in one step with the
        conditional score only; ``imgs_final``, denoised in ``eval_steps`` steps; and ``texts``,
        ``noise_levels`` and ``bs``, the number of items."""
    size, most = len(noised.t), guidance.cfg.max_items_eval
    count = size if most < 1 else min(most, size)
    batch = items_of(batch, size, slice(count))
    t, abar, _, z = (values[:count] for values in noised)
    condition = guidance.condition(prompt_utils, **batch)
    latents = {
        "imgs_noisy": z,
        "imgs_1step": sds.predict_x0(z, guidance.predict_noise(z, t, condition), abar),
        "imgs_1orig": sds.predict_x0(z, guidance.predict(z, t, condition)[0].float(), abar),
        "imgs_final": sds.ddim_sample(
            lambda z, t: guidance.predict_noise(z, t, condition),
            z,
            t,
            guidance.alphas_cumprod.double().to(z.device),
            steps=guidance.cfg.eval_steps,
        ),
    }
    levels = (t / len(guidance.alphas_cumprod)).tolist()
    images = {
        name: guidance.decode(value).float().movedim(1, -1) for name, value in latents.items()
    }
    return {"bs": count, "noise_levels": levels, "texts": _captions(levels, batch), **images}


def items_of(batch: dict[str, Any], size: int, index: Any) -> dict[str, Any]:
    """Select items of a batch of ``size`` items; ``index`` is anything that indexes a tensor's
    first dimension.
    """
    return {
        k: v[index] if isinstance(v, Tensor) and v.dim() and len(v) == size else v
        for k, v in batch.items()
    }


def _captions(levels: list[float], batch: dict[str, Any]) -> list[str]:
    """Write threestudio's captions: noise level, elevation, azimuth and distance of each item."""
    captions = [f"n{level:.02f}" for level in levels]
    for letter, name, digits in (
        ("e", "elevation", 1),
        ("a", "azimuth", 1),
        ("c", "camera_distances", 2),
    ):
        if name in batch:
            captions = [
                f"{caption}\n{letter}{float(value):.0{digits}f}"
                for caption, value in zip(captions, batch[name], strict=True)
            ]
    return captions
