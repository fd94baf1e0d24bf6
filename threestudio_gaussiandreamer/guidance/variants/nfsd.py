"""``nfsd-variant``: noise-free score distillation (Katzir et al. 2023, arXiv:2310.17590): the
direction of the prompt and that of the data's domain, without the predicted noise.

    e = delta_D + guidance_scale delta_C,   delta_C = eps_c - eps_0
    delta_D = eps_0                         if t < threshold, where the noise in eps_0 is small
            = eps_0 - eps_n                 otherwise        (the paper's eq. 6)

eps_0 is the prediction for an empty prompt, eps_n that for the negative prompt; without one they
are the unconditional score. The threshold is 0.2 of the timesteps and the ``guidance_scale`` 7.5 in
the paper. There are no options."""

from dataclasses import dataclass
from typing import Any

import torch

from ...diffusion.sds import per_item
from ...host import register
from ..types import Batch, Latents, Residual
from .base import Variant

THRESHOLD = 0.2
"""Timestep, as a share of all, below which delta_D is eps_0."""


@register("nfsd-variant")
class NFSD(Variant):
    NEEDS_UNCONDITIONAL = NEEDS_EMPTY_PROMPT = True
    IGNORES = ("guidance_interval", "recon_std_rescale")

    @dataclass
    class Config(Variant.Config):
        REMOVED = {"threshold": (THRESHOLD, f"it is {THRESHOLD}")}

    def residual(self, guidance: Any, latents: Latents, condition: Any, batch: Batch) -> Residual:
        noised = guidance.add_noise(latents)
        cond, negative = guidance.both(noised.z, noised.t, condition)
        empty = guidance.empty_prompt(noised.z, noised.t, condition)
        empty = negative if empty is None else empty
        small = noised.t < THRESHOLD * len(guidance.alphas_cumprod)
        domain = empty - torch.where(per_item(small, cond) > 0, 0.0, negative)
        return domain + guidance.cfg.guidance_scale * (cond - empty), noised.abar
