"""Pictures of the score model's inputs and predictions, for the host's
``guidance_evaluation_save`` and for validation.
"""

from typing import Any

import torch

from ..diffusion import sds
from .types import Batch, Noised, items_of


@torch.no_grad()
def score_pictures(
    guidance: Any, noised: Noised, prompt_utils: Any, batch: Batch
) -> dict[str, Any]:
    """Decode the noisy latents and the predictions of a guidance's score model.

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
    images = {
        name: guidance.decode(value).float().movedim(1, -1) for name, value in latents.items()
    }
    levels = (t / len(guidance.alphas_cumprod)).tolist()
    return {"bs": count, "noise_levels": levels, "texts": _captions(levels, batch), **images}


def _captions(levels: list[float], batch: Batch) -> list[str]:
    """Write threestudio's captions: noise level, elevation, azimuth and distance of each item."""
    shown = (("e", "elevation", 1), ("a", "azimuth", 1), ("c", "camera_distances", 2))
    columns = [[f"n{level:.02f}" for level in levels]] + [
        [f"{letter}{float(value):.0{digits}f}" for value in batch[name]]
        for letter, name, digits in shown
        if name in batch
    ]
    return ["\n".join(lines) for lines in zip(*columns, strict=True)]
