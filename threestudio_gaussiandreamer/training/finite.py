"""Stop a run whose parameters or optimiser state aren't finite, or whose parameters the optimiser
doesn't have, before they are saved: the rasteriser skips Gaussians with NaN, so that such a run
would end without an error. Warn of one whose first renders are empty.
"""

from collections.abc import Iterable, Iterator, Mapping
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.distributed import all_max
from ..core.errors import UserError
from ..host import warn

CHECK_EVERY = 25
"""Optimiser steps between two checks, each of which synchronises with the device once."""
LIMITS = {"means": 1e9, "log_scales": 30.0, "sh0": 1e9, "sh_rest": 1e9}
"""Magnitudes of a lost cloud: no camera sees so far, and scales of e^10 at most are drawn."""


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    """Yield parameters of an optimiser, and tensors of its state, such as ``means.exp_avg``."""
    for group in optimizer.param_groups:
        name = group.get("name", "parameters")
        for parameter in group["params"]:
            yield name, parameter
            for key, value in optimizer.state.get(parameter, {}).items():
                if isinstance(value, Tensor) and value.is_floating_point():
                    yield f"{name}.{key}", value


@torch.no_grad()
def require_finite(
    tensors: Iterable[tuple[str, Tensor]],
    step: int,
    losses: Iterable[tuple[int, Mapping[str, Tensor]]] = (),
) -> None:
    """Check that no tensor contains NaN, infinity or, of a cloud, numbers beyond ``LIMITS``;
    synchronises with the device once.

    Args:
        losses: the weighted losses of the steps since the last check, read only for the message.

    Raises:
        UserError: names the first bad tensor, how many values, and the loss that may be the cause.
    """
    named = [
        (name, values, LIMITS.get(name.rpartition(".")[2], torch.finfo(values.dtype).max))
        for name, values in tensors
        if values.numel()
    ]
    fits = [(torch.stack(values.aminmax()).abs() <= limit).all() for _, values, limit in named]
    if not fits or torch.stack([fit.to(fits[0].device) for fit in fits]).all():
        return
    name, values, limit = named[[bool(fit) for fit in fits].index(False)]
    bad, what = ~values.isfinite(), "NaN or infinite"
    if not bad.any():
        bad, what = values.abs() > limit, f"beyond {limit:g}"
    causes = (
        f", after the weighted loss_{loss} was {value.item()} in step {number}"
        for number, of_step in losses
        for loss, value in of_step.items()
        if not value.isfinite().all()
    )
    raise UserError(
        f"step {step}: {int(bad.sum())} of the {values.numel()} numbers of {name} "
        f"are {what}{next(causes, '')}: the run stops, and nothing of "
        "this state is saved or exported. "
        "Usual causes are a guidance that returns NaN, an optimiser without a positive eps "
        "(system.optimizer.args), weights of losses that overflow float32 (system.loss), too "
        "large learning rates (system.geometry.lr_*) and, at the start, sizes in the options of "
        "system.geometry.prior and grow"
    )


def require_optimised(
    geometry: torch.nn.Module, optimizers: Iterable[torch.optim.Optimizer]
) -> None:
    """Raise UserError if a parameter of the cloud was replaced without the optimiser."""
    groups = [group for optimizer in optimizers for group in optimizer.param_groups]
    trained = {id(parameter) for group in groups for parameter in group["params"]}
    for name, parameter in geometry.named_parameters():
        if trained and parameter.numel() and id(parameter) not in trained:
            raise UserError(
                f"geometry.{name} isn't among the optimiser's parameters, so that it isn't "
                "trained: a density rule replaces them by cloud.apply_change(change, optimizer)"
            )


def warn_if_invisible(opacity: Float[Tensor, "B H W 1"], step: int) -> None:
    """Warn if all renders of the first step are empty: it then trains no Gaussian."""
    if step == 0 and not all_max(opacity.detach().amax()):
        warn(
            "no Gaussian is visible in the first step's views, so it trains none: check size and "
            "place of the prior, system.geometry.init_opacity, and the cameras' distances"
        )


def loss_scale(trainer: Any) -> float:
    """Return the factor of mixed precision on gradients, else 1; if they overflow, it is halved."""
    scaler = getattr(trainer.precision_plugin, "scaler", None)
    return 1.0 if scaler is None else float(scaler.get_scale())
