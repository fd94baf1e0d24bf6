"""Check the training state in a checkpoint before it is restored, since Lightning fails on some
content only after it has restored a part, and restores other content without an error."""

import re
from collections.abc import Mapping
from typing import Any

import torch
from torch import Tensor

from ..core.errors import UserError
from ..core.options import shown
from ..host import pl
from ..training.finite import optimizer_tensors

MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer")
"""Entries of torch's optimiser state that have the shape of the parameter."""
OLDEST = "2.0"
"""Oldest version of Lightning whose checkpoints can be resumed."""


def check_training_state(checkpoint: Mapping[str, Any], optimizer: Mapping, what: str) -> None:
    """Restore the loops and the optimisers as Lightning does, into objects of their own.

    Args:
        optimizer: the section ``system.optimizer``: name and args.
        what: the file, for messages.

    Raises:
        UserError: a state can't be restored, or is at another step than the file says.
    """
    version = str(checkpoint.get("pytorch-lightning_version", OLDEST))
    if not re.match(r"([2-9]|[1-9]\d+)\.\d+", version):
        raise UserError(
            f"{what}: its pytorch-lightning_version is {shown(version)}; expected {OLDEST} or later"
        )
    counted, step = _restored_steps(checkpoint["loops"], what), checkpoint["global_step"]
    if counted != step:
        raise UserError(f"{what}: its loops are at step {counted}, its global_step is {step}")
    kind = getattr(torch.optim, str(optimizer.get("name", "Adam")), None)
    if kind is None:
        return
    try:
        if not checkpoint["optimizer_states"]:
            raise ValueError("there is no optimiser")
        for state in checkpoint["optimizer_states"]:
            _try_step(kind, state, checkpoint["state_dict"])
    except Exception as error:  # torch doesn't check keys and types
        raise UserError(
            f"{what}: {kind.__name__} can't resume from its optimizer_states, which may be another "
            f"optimiser's: {type(error).__name__} {error}"
        ) from error


def _restored_steps(loops: Any, what: str) -> int:
    """Return how many steps Lightning's loops have made."""
    trainer = pl.Trainer(accelerator="cpu", devices=1, logger=False, enable_checkpointing=False)
    try:
        trainer.fit_loop.load_state_dict(loops["fit_loop"])
        epoch = trainer.fit_loop.epoch_loop
        counted = epoch.automatic_optimization.optim_progress.optimizer_steps
        return counted + epoch.manual_optimization.optim_step_progress.total.completed
    except Exception as error:  # Lightning doesn't check keys and types
        raise UserError(
            f"{what}: its loops aren't those of Lightning: {type(error).__name__} {error}"
        ) from error


def _try_step(kind: type, state: Mapping, parameters: Mapping) -> None:
    """Restore a state into an optimiser of zeros and make a step with zero gradients, so that
    missing or invalid entries fail here.
    """
    groups = [
        {"params": [_zeros(index, group, state["state"], parameters) for index in group["params"]]}
        for group in state["param_groups"]
    ]
    restored = kind(groups, lr=0.0)
    restored.load_state_dict(dict(state))
    restored.step()
    for name, value in optimizer_tensors(restored):
        if not value.isfinite().all():
            raise ValueError(f"{name} is NaN or infinite")


def _zeros(index: Any, group: Mapping, moments: Mapping, parameters: Mapping) -> Tensor:
    """Return a parameter of zeros with a zero gradient, in the shape that it has in the run."""
    entry = moments.get(index, {})
    like = parameters.get(f"geometry.{group.get('name')}")
    if like is None:
        like = next((entry[key] for key in MOMENTS if key in entry), torch.zeros(()))
    parameter = torch.zeros(like.shape, requires_grad=True)
    parameter.grad = torch.zeros_like(parameter)
    return parameter
