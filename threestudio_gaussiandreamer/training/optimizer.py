"""The optimiser of ``system.optimizer``: ``{name, args}``, a class of ``torch.optim``."""

import inspect
from collections.abc import Mapping
from typing import Any

import torch

from ..core.devices import get_device
from ..core.errors import UserError, unknown

DEFAULTS = {"betas": (0.9, 0.99), "eps": 1e-15}
"""Arguments unless given, for optimisers that take them."""
Groups = list[dict[str, Any]]


def make_optimizer(options: Any, groups: Groups) -> torch.optim.Optimizer:
    """Build the optimiser over parameter groups that bring their own learning rates."""
    kind = getattr(torch.optim, options.get("name", "Adam"))
    accepted = inspect.signature(kind).parameters
    ours = {name: value for name, value in DEFAULTS.items() if name in accepted}
    return kind(groups, lr=0.0, **ours | dict(options.get("args", {})))


def check_optimizer(options: Any, scheduler: Any = None) -> None:
    """Raise UserError for a name that ``torch.optim`` lacks, arguments that it refuses, or a
    scheduler.
    """
    if scheduler is not None:
        raise UserError(
            "scheduler isn't used: learning rates are schedules themselves, for instance "
            "system.geometry.lr_means"
        )
    for key in options:
        if key not in ("name", "args"):
            raise unknown("key system.optimizer.", key, ("name", "args"))
    name, arguments = options.get("name", "Adam"), options.get("args", {})
    if not isinstance(getattr(torch.optim, str(name), None), type):
        known = [name for name, value in vars(torch.optim).items() if isinstance(value, type)]
        raise unknown("system.optimizer.name", name, known)
    if not isinstance(arguments, Mapping):
        raise UserError(f"optimizer.args: expected keys and values, got {arguments!r}")
    try:
        optimizer = make_optimizer(options, [_some_group(), _some_group()])
        if not (arguments.get("capturable") and get_device().type == "cuda"):
            optimizer.step()  # on the CPU, which would refuse what a GPU takes
    except Exception as error:  # of many types
        accepted = inspect.signature(getattr(torch.optim, name)).parameters.keys()
        accepted = accepted - {"params", "lr"}  # which the groups bring
        wrong = [unknown("argument", key, accepted) for key in arguments if key not in accepted]
        raise UserError(
            f"optimizer: {name} doesn't accept this: {wrong[0] if wrong else error}"
        ) from error


def _some_group() -> dict[str, Any]:
    parameter = torch.zeros(1, requires_grad=True)
    parameter.grad = torch.zeros_like(parameter)
    return {"params": [parameter], "lr": 0.0}
