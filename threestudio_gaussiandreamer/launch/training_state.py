"""Check the training state in a checkpoint before it is restored, since Lightning restores some
invalid content without an error, and fails on other content after it has restored a part."""

import re
from collections.abc import Iterator, Mapping
from typing import Any

import torch
from torch import Tensor

from ..core.checkpoint_file import is_count
from ..core.errors import UserError
from ..core.options import is_number, shown
from ..host import pl
from ..training.finite import optimizer_tensors

MOMENTS = ("exp_avg", "exp_avg_sq", "max_exp_avg_sq", "momentum_buffer")
"""Entries of torch's optimiser state that have the shape of the parameter."""
TYPES = {
    "pytorch-lightning_version": str,
    "callbacks": Mapping,
    "lr_schedulers": (list, tuple),
    "hyper_parameters": Mapping,
}
"""Types of optional entries that Lightning reads."""
OLDEST = "2.0"
"""Oldest version of Lightning whose checkpoints can be resumed."""
CHECKPOINT_STATE = {
    **dict.fromkeys(
        ("best_model_path", "kth_best_model_path", "last_model_path"), (str, type(None))
    ),
    "dirpath": (str, type(None)),
    "best_k_models": Mapping,
    **dict.fromkeys(
        ("best_model_score", "current_score", "kth_value"), (Tensor, int, float, type(None))
    ),
}
"""Types of the entries that ModelCheckpoint restores."""


def check_training_state(checkpoint: Mapping[str, Any], optimizer: Mapping, what: str) -> None:
    """Check the loops, the optimisers and all else that Lightning restores.

    Args:
        optimizer: the section ``system.optimizer``: name and args.
        what: the file, for messages.

    Raises:
        UserError: an entry is missing, or its type, value or shape is one that no run writes.
    """
    for key in TYPES.keys() & checkpoint.keys():
        if not isinstance(checkpoint[key], TYPES[key]):
            raise UserError(f"{what}: its {key} is of type {type(checkpoint[key]).__name__}")
    _check_version(checkpoint.get("pytorch-lightning_version", OLDEST), what)
    for name, state in checkpoint.get("callbacks", {}).items():
        _check_callback(state, f"{what}: its callbacks[{name!r}]")
    _check_loops(checkpoint, what)
    _check_optimizers(checkpoint, what)
    for state in checkpoint["optimizer_states"]:
        _try_step(optimizer, state, checkpoint["state_dict"], what)


def _check_version(version: str, what: str) -> None:
    """Raise UserError for a checkpoint of Lightning 1, whose conversion isn't supported."""
    if not re.match(r"([2-9]|[1-9]\d+)\.\d+", version):
        raise UserError(
            f"{what}: its pytorch-lightning_version is {shown(version)}; expected {OLDEST} or later"
        )


def _check_callback(state: Any, name: str) -> None:
    """Check the types of the entries that ModelCheckpoint restores; the state of other callbacks
    isn't checked further.
    """
    if not isinstance(state, Mapping):
        raise UserError(f"{name} is of type {type(state).__name__}")
    for key in CHECKPOINT_STATE.keys() & state.keys():
        if not isinstance(state[key], CHECKPOINT_STATE[key]):
            raise UserError(f"{name}: its {key} is of type {type(state[key]).__name__}")


# -- loops -----------------------------------------------------------------------------------------


def _check_loops(checkpoint: Mapping[str, Any], what: str) -> None:
    loops, step = checkpoint["loops"], checkpoint["global_step"]
    fit = loops.get("fit_loop") if isinstance(loops, Mapping) else None
    if not isinstance(fit, Mapping):
        raise UserError(f"{what}: its loops have no fit_loop, in which Lightning counts the steps")
    for path, value in _leaves(loops, "loops"):
        if not isinstance(value, bool) and not is_count(value):
            raise UserError(f"{what}: its {path} is {shown(value)}; expected a count")
    trainer = pl.Trainer(accelerator="cpu", devices=1, logger=False, enable_checkpointing=False)
    missing = sorted(trainer.fit_loop.state_dict().keys() - fit.keys())
    if missing and checkpoint.get("pytorch-lightning_version") == pl.__version__:
        raise UserError(f"{what}: its fit_loop has no {missing[0]}")
    try:
        trainer.fit_loop.load_state_dict(fit)
        epoch = trainer.fit_loop.epoch_loop
        counted = epoch.automatic_optimization.optim_progress.optimizer_steps
        counted += epoch.manual_optimization.optim_step_progress.total.completed
    except Exception as error:  # Lightning doesn't check keys and types
        raise UserError(
            f"{what}: its fit_loop isn't one of Lightning's: {type(error).__name__} {error}"
        ) from error
    if counted != step:
        raise UserError(f"{what}: its loops are at step {counted}, its global_step is {step}")


def _leaves(node: Mapping, path: str) -> Iterator[tuple[str, Any]]:
    """Yield the path and value of each leaf of a nested mapping, except below keys that end in
    ``state_dict``, whose content is the loop's own.
    """
    for key, value in node.items():
        if str(key).endswith("state_dict"):
            continue
        if isinstance(value, Mapping):
            yield from _leaves(value, f"{path}.{key}")
        else:
            yield f"{path}.{key}", value


# -- optimisers ------------------------------------------------------------------------------------


def _check_optimizers(checkpoint: Mapping[str, Any], what: str) -> None:
    states = checkpoint["optimizer_states"]
    if not isinstance(states, (list, tuple)) or not states:
        raise UserError(f"{what}: its optimizer_states hold no optimiser")
    for i, state in enumerate(states):
        name = f"{what}: its optimizer_states[{i}]"
        groups = _groups(state, name)
        has_moments = not all(map(_is_plain_descent, groups))
        if checkpoint["global_step"] > 0 and has_moments and not state["state"]:
            raise UserError(f"{name} has no moments, though the run is at a later step than 0")
        for group in groups:
            _check_group(group, state["state"], checkpoint["state_dict"], name)


def _groups(state: Any, name: str) -> list[Mapping]:
    if not (isinstance(state, Mapping) and {"state", "param_groups"} <= set(state)):
        raise UserError(f"{name} has no state and param_groups")
    groups, moments = state["param_groups"], state["state"]
    if not isinstance(moments, Mapping) or not all(
        isinstance(entry, Mapping) for entry in moments.values()
    ):
        raise UserError(f"{name}.state isn't a mapping of mappings")
    if not isinstance(groups, (list, tuple)) or not all(
        isinstance(group, Mapping) and isinstance(group.get("params"), (list, tuple))
        for group in groups
    ):
        raise UserError(f"{name}.param_groups isn't a list of groups with params")
    return list(groups)


def _is_plain_descent(group: Mapping) -> bool:
    """Return whether a group is of torch's SGD without momentum, which has no state."""
    return "nesterov" in group and not group.get("momentum")


def _check_group(group: Mapping, moments: Mapping, parameters: Mapping, name: str) -> None:
    label = str(group.get("name", "parameters"))
    for key in ("lr", "eps", "weight_decay", "momentum"):
        if not is_number(group.get(key, 0)):
            raise UserError(f"{name}: the {key} of the group {label} is {shown(group[key])}")
    parameter = parameters.get(f"geometry.{label}")
    for index in group["params"]:
        for key, value in moments.get(index, {}).items() if _is_index(index) else ():
            _check_moment(value, parameter if key in MOMENTS else None, f"{name}: {label}.{key}")


def _is_index(index: Any) -> bool:
    return isinstance(index, int)


def _check_moment(value: Any, parameter: Any, name: str) -> None:
    if parameter is not None and (not isinstance(value, Tensor) or value.shape != parameter.shape):
        found = tuple(value.shape) if isinstance(value, Tensor) else type(value).__name__
        raise UserError(f"{name} has the shape {found}; expected {tuple(parameter.shape)}")
    if isinstance(value, Tensor) and value.layout == torch.strided and not value.isfinite().all():
        raise UserError(f"{name} holds NaN or infinity")


def _try_step(optimizer: Mapping, state: Mapping, parameters: Mapping, what: str) -> None:
    """Restore the state into an optimiser of zeros and make a step with zero gradients, so that
    missing or invalid entries fail here.

    Raises:
        UserError: torch doesn't accept the state, or the step fails or gives NaN or infinity.
    """
    kind = getattr(torch.optim, str(optimizer.get("name", "Adam")), None)
    if kind is None:
        return
    groups = [
        {"params": [_zeros(index, group, state["state"], parameters) for index in group["params"]]}
        for group in state["param_groups"]
    ]
    try:
        restored = kind(groups, lr=0.0)
        restored.load_state_dict(dict(state))
        restored.step()
    except Exception as error:  # torch doesn't check keys and types
        raise UserError(
            f"{what}: {kind.__name__} can't resume from its optimizer_states, which may be another "
            f"optimiser's: {type(error).__name__} {error}"
        ) from error
    for name, value in optimizer_tensors(restored):
        if not value.isfinite().all():
            raise UserError(
                f"{what}: a step of {kind.__name__} from its optimizer_states makes {name} NaN or "
                "infinite"
            )


def _zeros(index: Any, group: Mapping, moments: Mapping, parameters: Mapping) -> Tensor:
    """Return a parameter of zeros with a zero gradient, in the shape that it has in the run."""
    known = parameters.get(f"geometry.{group.get('name')}")
    entry = moments.get(index, {}) if _is_index(index) else {}
    like = next((entry[key] for key in MOMENTS if isinstance(entry.get(key), Tensor)), known)
    parameter = torch.zeros(() if like is None else like.shape, requires_grad=True)
    parameter.grad = torch.zeros_like(parameter)
    return parameter
