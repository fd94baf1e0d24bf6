"""How the system calls guidances, its own and other packages'."""

import inspect
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ..core.errors import UserError
from ..core.streams import derive_seed
from ..host import item_seed
from .base import ScoreDistillation


def call_guidance(
    guidance: Any,
    rgb: Float[Tensor, "B H W 3"],
    prompt_utils: Any,
    batch: dict[str, Any],
    **options: Any,
) -> dict[str, Any]:
    """Call ``guidance`` with these renders, and those of ``prompt_utils``, the entries of the batch
    and the options that its signature accepts. The second positional argument gets the prompt under
    any name, as from threestudio. Raise UserError if it returns no dict, or a ``loss_*`` that isn't
    a single finite number.
    """
    call = guidance.forward if isinstance(guidance, nn.Module) else guidance.__call__
    arguments = inspect.signature(call).parameters
    given = {"prompt_utils": prompt_utils, **batch, **options}
    for second in list(arguments.values())[1:2]:
        is_positional = second.kind is second.POSITIONAL_OR_KEYWORD
        if is_positional and second.default is second.empty and second.name not in given:
            given[second.name] = given.pop("prompt_utils")
    if not any(argument.kind is argument.VAR_KEYWORD for argument in arguments.values()):
        given = {name: value for name, value in given.items() if name in arguments}
    out, name = guidance(rgb, **given), type(guidance).__name__
    if isinstance(guidance, ScoreDistillation):
        return out
    if not isinstance(out, dict):
        raise UserError(f"{name} returned {type(out).__name__}: expected a dict with loss_*")
    losses = {key: value for key, value in out.items() if key.startswith("loss_")}
    return out | {key: _loss(value, f"{name} returned {key}", rgb) for key, value in losses.items()}


def _loss(value: Any, what: str, rgb: Tensor) -> Float[Tensor, ""]:
    """Return a loss as a tensor, since some guidances return plain numbers for disabled ones."""
    try:
        loss = torch.as_tensor(value, device=rgb.device).reshape(())
    except (TypeError, ValueError, RuntimeError) as error:
        kind = getattr(value, "shape", None) or type(value).__name__
        raise UserError(f"{what} of {kind}: expected one number, as from .mean()") from error
    if loss.device.type == "cpu" and not loss.isfinite():  # on a GPU, looking would wait for it
        raise UserError(f"{what} = {loss.item()}: expected a finite number")
    return loss


@contextmanager
def own_randomness(step: int) -> Iterator[None]:
    """Seed torch's global generators with (seed, step) in this context, for guidances that draw
    from them, so that a resumed run draws the same; restore their state afterwards.
    """
    with torch.random.fork_rng([torch.cuda.current_device()] if torch.cuda.is_available() else []):
        torch.manual_seed(derive_seed(item_seed(), "guidance", step))
        yield


def truth_of(guidance: Any) -> Any:
    """Return the ground truth that renders are compared with, if a guidance has one; else None. It
    has the methods of :class:`.MeshTruth`, whose ``mesh`` may be None. A guidance that has computed
    the mean squared error of a step's renders to it returns that as ``error_to_truth``.
    """
    return getattr(guidance, "truth", None)


def trainable_parameters(guidance: Any) -> dict[str, nn.Parameter]:
    """Return the parameters that a guidance trains, by name."""
    named = guidance.named_parameters() if isinstance(guidance, nn.Module) else ()
    return {name: parameter for name, parameter in named if parameter.requires_grad}


def trainable_groups(guidance: Any, lr: float) -> list[dict[str, Any]]:
    """Return an optimiser group of those parameters; none for most guidances."""
    learning = list(trainable_parameters(guidance).values())
    return [{"params": learning, "name": "guidance", "lr": lr}] if learning else []


def learnt_weights(guidance: Any) -> dict[str, Tensor]:
    """Return what a guidance has learnt, for a checkpoint: its parameters or its state."""
    if isinstance(guidance, ScoreDistillation):
        return guidance.state()
    return {name: parameter.detach() for name, parameter in trainable_parameters(guidance).items()}


def restore_learnt(guidance: Any, weights: dict[str, Tensor]) -> None:
    """Restore what :func:`learnt_weights` returned; raise UserError if names or shapes differ."""
    if isinstance(guidance, ScoreDistillation):
        return guidance.restore(weights)
    own = trainable_parameters(guidance)
    shapes = [{name: value.shape for name, value in part.items()} for part in (own, weights)]
    if shapes[0] != shapes[1]:
        raise UserError(
            f"the checkpoint's guidance had learnt {len(weights)} tensors, and "
            f"{type(guidance).__name__} learns {len(own)} of its own:"
            " resume with the configuration that the run was started with"
        )
    with torch.no_grad():
        for name, parameter in own.items():
            parameter.copy_(weights[name])
