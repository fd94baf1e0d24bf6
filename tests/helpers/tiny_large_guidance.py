"""The guidances of larger models with tiny ones, and stand-ins for their networks."""

from types import SimpleNamespace
from typing import Any, Callable

import torch
from torch import Tensor, nn

from tests.helpers.tiny_guidance import BATCH, part, prompts_of
from threestudio_gaussiandreamer.cameras import orbit_c2w
from threestudio_gaussiandreamer.launch import parts  # noqa: F401


def guidance(kind: str, folder: Any, **options: Any) -> Any:
    return part(f"{kind}-guidance", folder, **options)


def prompts(kind: str, folder: Any, **options: Any) -> Any:
    return prompts_of(kind, folder, **{"negative_prompt": "ugly"} | options)


def views(**changes: Tensor) -> dict[str, Tensor]:
    """Return the angles and matrices of four views."""
    batch = BATCH | changes
    angles = (batch["elevation"], batch["azimuth"], batch["camera_distances"])
    return batch | {"c2w": orbit_c2w(*angles)}


def gradient(guide: Any, prompt_utils: Any, rgb: Tensor, **options: Any) -> tuple[Tensor, dict]:
    out = guide(rgb, prompt_utils, **(views() | options))
    return torch.autograd.grad(out["loss_sds"], rgb)[0], out


class StandIn(nn.Module):
    """A network whose output is a function of its noisy latent and its other arguments."""

    def __init__(self, network: nn.Module, output: Callable[..., Tensor]) -> None:
        super().__init__()
        self.config, self.output = network.config, output

    def forward(self, *latent: Tensor, **options: Any) -> SimpleNamespace:
        return SimpleNamespace(sample=self.output(*latent, **options))
