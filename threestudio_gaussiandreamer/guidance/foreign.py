"""Guidances that other packages register: called as threestudio's systems call them, whichever of its signatures they have."""

import inspect
from typing import Any

from jaxtyping import Float
from torch import Tensor, nn


def call_guidance(guidance: Any, rgb: Float[Tensor, "B H W 3"], prompt_utils: Any, batch: dict[str, Any], **options: Any) -> dict[str, Any]:
    """What ``guidance`` returns for these renders.

    A guidance by text (Stable Diffusion, MVDream, VSD) gets ``prompt_utils``; one by an image (zero123) has no such argument. All get
    the whole batch and the options, or as much of them as they take.
    """
    call = guidance.forward if isinstance(guidance, nn.Module) else guidance.__call__
    arguments = inspect.signature(call).parameters
    given = {**batch, **options}
    if not any(argument.kind is argument.VAR_KEYWORD for argument in arguments.values()):
        given = {name: value for name, value in given.items() if name in arguments}
    return guidance(rgb, prompt_utils, **given) if "prompt_utils" in arguments else guidance(rgb, **given)


def trainable_groups(guidance: Any, lr: float) -> list[dict[str, Any]]:
    """The optimiser's group of what a guidance itself learns, as VSD its LoRA; none for most.

    Args:
        lr: its learning rate.
    """
    parameters = guidance.parameters() if isinstance(guidance, nn.Module) else ()
    learning = [parameter for parameter in parameters if parameter.requires_grad]
    return [{"params": learning, "name": "guidance", "lr": lr}] if learning else []
