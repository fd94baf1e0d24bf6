"""Stop a run whose parameters or optimiser state aren't finite, before anything of it is written.

NaN doesn't heal: Adam's moments keep it, and the rasteriser leaves the Gaussian out, so a run that
went on would end without an error and with holes.
"""

from collections.abc import Iterable, Iterator

import torch
from torch import Tensor

from ..core.errors import UserError

CHECK_EVERY = 25
"""Optimiser steps between two checks, each of which waits for the device once."""

Named = Iterable[tuple[str, Tensor]]


class NonFiniteParameters(UserError):
    """Training produced NaN or infinity."""


def optimizer_tensors(optimizer: torch.optim.Optimizer) -> Iterator[tuple[str, Tensor]]:
    """Yield every parameter and every state tensor of an optimiser with its name.

    A parameter is named after its group, a state tensor ``group.key``, such as ``means.exp_avg``.
    """
    for group in optimizer.param_groups:
        name = group.get("name", "parameters")
        for parameter in group["params"]:
            yield name, parameter
            for key, value in optimizer.state.get(parameter, {}).items():
                if isinstance(value, Tensor) and value.is_floating_point():
                    yield f"{name}.{key}", value


@torch.no_grad()
def require_finite(tensors: Named, step: int) -> None:
    """Check that no tensor holds NaN or infinity; waits for the device once.

    Args:
        tensors: (name, values of any shape).
        step: finished optimiser steps, for the message.

    Raises:
        NonFiniteParameters: names the first tensor that isn't finite, and how much of it.
    """
    named = list(tensors)
    # in float64 a sum of float32 can't overflow: it is finite exactly if all of its terms are
    sums = [values.sum(dtype=torch.float64).to(named[0][1].device) for _, values in named]
    if not sums or torch.stack(sums).isfinite().all():
        return
    name, values = next((n, v) for n, v in named if not v.isfinite().all())
    raise NonFiniteParameters(
        f"step {step}: {int((~values.isfinite()).sum())} of the {values.numel()} numbers of {name} "
        "are NaN or infinite: the run stops, and nothing of this state is saved or exported. "
        "Usual causes are an optimiser without a positive eps (system.optimizer.args), weights of "
        "losses that overflow float32 (system.loss) and too large learning rates "
        "(system.geometry.lr_*)"
    )
