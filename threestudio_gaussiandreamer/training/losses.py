"""The weighted losses of a step: those that the guidance returns, and regularisers of the renders
and the cloud, which are functions registered as ``<name>-regulariser``;
``system.loss.lambda_<name>`` is the weight of each, a number or a schedule.

========  ==========================================================================================
sparsity  mean sqrt(alpha^2 + 0.01)
opaque    entropy of alpha, smallest if every alpha is 0 or 1
tv        total variation: mean absolute difference of neighbouring pixels' colours, over each axis
========  ==========================================================================================

All are means over pixels, whereas score distillation is a sum over latents: raise their weights in
proportion to height x width.
"""

from collections.abc import Callable, Iterable, Mapping
from typing import Any, Optional

import torch
from jaxtyping import Float
from torch import Tensor

from ..core.errors import UserError, unknown
from ..guidance.base import ScoreDistillation
from ..host import find, names, register

SUFFIX = "-regulariser"


def regularisers() -> dict[str, Callable[[Mapping[str, Any]], Tensor]]:
    """Return the registered regularisers by the names of their losses."""
    return {name.removesuffix(SUFFIX): find(name) for name in names() if name.endswith(SUFFIX)}


def weighted_losses(
    guided: Mapping[str, Any], out: Mapping[str, Any], weights: Mapping[str, float]
) -> dict[str, Tensor]:
    """Compute the weighted ``loss_*`` of a guidance, and the weighted regularisers of ``out``, the
    renderer's outputs and the cloud as it is drawn; raises UserError as :func:`check_weights`.
    """
    raw = {k.removeprefix("loss_"): v for k, v in guided.items() if k.startswith("loss_")}
    if not raw:
        found = ", ".join(guided) or "nothing"
        raise UserError(f"the guidance returned no loss_*, such as loss_sds: it returned {found}")
    check_weights(weights, raw)
    for name, call in regularisers().items():
        if weights.get(name):
            value = call(out)
            if not isinstance(value, Tensor) or value.numel() != 1:
                found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
                raise UserError(
                    f"{name}{SUFFIX} returned {found}; expected one number that is computed from "
                    "the renders or the cloud, as from .mean()"
                )
            raw[name] = value.reshape(())
    return {name: value * weights[name] for name, value in raw.items()}


def total(losses: Mapping[str, Tensor]) -> Float[Tensor, ""]:
    """Return the sum of the losses; raise UserError if one that isn't a plain 0 has no gradient."""
    loss = sum(losses.values())
    constant = [name for name, value in losses.items() if not value.requires_grad and value != 0]
    if constant or not loss.requires_grad:
        names = ", ".join(f"loss_{name}" for name in (constant if loss.requires_grad else losses))
        raise UserError(
            f"{names} has no gradient: compute it from the renders, without detach() or "
            "torch.no_grad()"
        )
    return loss


def require_gradients(geometry: torch.nn.Module, losses: Mapping[str, Tensor]) -> None:
    """Raise UserError if no gradient of the losses has reached the cloud."""
    gradients = [parameter.grad for parameter in geometry.parameters()]
    if gradients and all(gradient is None for gradient in gradients):
        names = ", ".join(f"loss_{name}" for name in losses)
        raise UserError(
            f"no gradient of {names} reaches the Gaussians, so that they wouldn't be trained: "
            "compute it from the renders, without detach() or torch.no_grad()"
        )


def loggable(guided: Mapping[str, Any], losses: Mapping[str, Tensor]) -> dict[str, Any]:
    """Return what is logged of a step: the guidance's scalars, and the weighted losses."""
    weighted = {f"loss_{name}": value.detach() for name, value in losses.items()}
    scalars = {
        name: value
        for name, value in guided.items()
        if not (name.startswith("loss_") or name == "error_to_truth")
        and (isinstance(value, (int, float)) or isinstance(value, Tensor) and value.numel() == 1)
    }
    return {f"train/{name}": value for name, value in (scalars | weighted).items()}


def logged_names(guidance: type, options: Iterable[str]) -> Optional[set[str]]:
    """Return the names that a run with these loss weights logs; None if that isn't known."""
    if not issubclass(guidance, ScoreDistillation):
        return None
    guided = [name.replace("lambda_", "loss_", 1) for name in options]
    guided += ["grad_norm", "min_step", "max_step", "bad_items", "evaluations", *guidance.REPORTS]
    known = {"loss", "gaussians", *(f"train/{name}" for name in guided)}
    return known | {"dB"} if guidance.KNOWS_TRUTH else known


def check_losses(guidance: type, options: Mapping[str, Any]) -> None:
    """Raise UserError for wrong keys of ``system.loss``, also by the guidance's ``LOSSES``."""
    for name in options:
        if not name.startswith("lambda_"):
            called = "weights of losses are called lambda_<loss>, such as lambda_sds"
            raise UserError(f"unknown key 'system.loss.{name}': {called}")
    if options and not any(options.values()):
        raise UserError(
            "system.loss: every weight is 0, so that nothing would be trained: give one, such as "
            "system.loss.lambda_sds=1"
        )
    for name, call in regularisers().items():
        if options.get(f"lambda_{name}") and isinstance(call, type):
            raise UserError(f"{name}{SUFFIX} is a class; register a function of the outputs")
    known = getattr(guidance, "LOSSES", None)  # also of guidances that aren't ScoreDistillation
    if known is not None:
        check_weights({key.removeprefix("lambda_"): value for key, value in options.items()}, known)


def check_weights(weights: Mapping[str, Any], losses: Iterable[str]) -> None:
    """Check that every weight belongs to a loss or a regulariser, and that every loss has a weight.
    A weight of 0 or None without a loss is how an overlay removes that of an earlier file.

    Raises:
        UserError: a weight or a loss has no counterpart, or a loss has a regulariser's name.
    """
    ours = regularisers()
    for name, weight in weights.items():
        if name not in losses and name not in ours and weight:
            known = [f"lambda_{n}" for n in (*losses, *ours)]
            error = unknown("weight system.loss.lambda_*", f"lambda_{name}", known)
            raise UserError(
                f"{str(error).removesuffix('.')} (to leave it out: system.loss.lambda_{name}=0; a "
                f"regulariser of your own is a function below @register({name + SUFFIX!r}))"
            )
    for name in losses:
        if name in ours:
            raise UserError(
                f"{name}{SUFFIX} has the name of the guidance's loss_{name}; choose another one"
            )
        if name not in weights:
            raise UserError(
                f"the guidance returns loss_{name}: give its weight, for instance "
                f"system.loss.lambda_{name}=1"
            )


def foreign_weights(options: Iterable[str], guidance: Any) -> list[str]:
    """Return the keys of ``system.loss`` that belong to neither a regulariser nor a loss that the
    class of the guidance declares as ``LOSSES``; an empty list if it declares none.
    """
    if (losses := getattr(guidance, "LOSSES", None)) is None:
        return []
    known = {f"lambda_{name}" for name in (*losses, *regularisers())}
    return [key for key in options if key.startswith("lambda_") and key not in known]


@register("sparsity-regulariser")
def sparsity(out: Mapping[str, Any]) -> Float[Tensor, ""]:
    """Return the mean of sqrt(alpha^2 + 0.01), as in threestudio."""
    return (out["opacity"] ** 2 + 0.01).sqrt().mean()


@register("opaque-regulariser")
def opaque(out: Mapping[str, Any]) -> Float[Tensor, ""]:
    """Return the mean entropy of alpha, clamped to [1e-3, 1 - 1e-3], as in threestudio."""
    clamped = out["opacity"].clamp(1e-3, 1 - 1e-3)
    # torch forbids its binary_cross_entropy under mixed precision
    return -(clamped * clamped.log() + (1 - clamped) * (1 - clamped).log()).mean()


@register("tv-regulariser")
def total_variation(out: Mapping[str, Any]) -> Float[Tensor, ""]:
    """Return the mean absolute difference of vertical neighbours plus that of horizontal ones."""
    differences = out["comp_rgb"].diff(dim=1), out["comp_rgb"].diff(dim=2)
    return sum(found.abs().sum() / max(found.numel(), 1) for found in differences)
