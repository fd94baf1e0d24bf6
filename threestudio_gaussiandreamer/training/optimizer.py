"""The optimiser of ``system.optimizer``: ``{name, args}``, a class of ``torch.optim``, and
``params``, the learning rates of other packages' parts: ``{background: {lr: 0.01}}``.
"""

import inspect
from collections.abc import Mapping
from typing import Any, Optional

import torch

from ..core.devices import get_device
from ..core.errors import UserError, unknown
from ..core.options import RULE, is_list, schedule
from ..core.schedule import parse_schedule
from ..host import C
from .background import FlatBackground

DEFAULTS = {"betas": (0.9, 0.99), "eps": 1e-15}
"""Arguments unless given, for optimisers that take them."""
Groups = list[dict[str, Any]]
PARTS = ("background", "material", "renderer")
"""Parts that may have parameters, beside the geometry."""
RATE = schedule(min=0)


def make_optimizer(options: Any, groups: Groups) -> torch.optim.Optimizer:
    """Build the optimiser over parameter groups that bring their own learning rates."""
    name, given = options.get("name", "Adam"), options.get("args") or {}
    foreign = foreign_arguments(name, DEFAULTS)
    ours = {key: value for key, value in DEFAULTS.items() if key not in foreign}
    given = ours | {key: value for key, value in given.items() if value is not None}
    given = {key: tuple(value) if is_list(value) else value for key, value in given.items()}
    return getattr(torch.optim, name)(groups, lr=0.0, **given)


def restore_arguments(optimizer: torch.optim.Optimizer) -> None:
    """Set the numbers of this configuration, such as betas and weight decay, in all groups; a
    checkpoint has restored those of its run. Learning rates are set in each step.
    """
    kinds = int, float, list, tuple
    numbers = {k: v for k, v in optimizer.defaults.items() if isinstance(v, kinds) and k != "lr"}
    for group in optimizer.param_groups:
        group.update({k: v for k, v in numbers.items() if not isinstance(v, bool)})


def accepted_arguments(name: str) -> dict[str, Any]:
    """Return an optimiser's arguments, except those that the system gives, with defaults."""
    kind = getattr(torch.optim, str(name), None)
    parameters = inspect.signature(kind).parameters if isinstance(kind, type) else {}
    return {key: parameters[key].default for key in parameters if key not in ("params", "lr")}


def foreign_arguments(name: str, arguments: Mapping[str, Any]) -> list[str]:
    """Return the arguments that an optimiser lacks, or has as a pair in place of a number, as
    ``eps`` of Adafactor; none if there is no such optimiser.
    """
    if not (accepted := accepted_arguments(name)):
        return []
    given = arguments.items()
    return [k for k, v in given if k not in accepted or is_list(accepted[k]) != is_list(v)]


def check_optimizer(options: Any, scheduler: Any = None) -> None:
    """Raise UserError for a name or arguments that ``torch.optim`` refuses, or a scheduler."""
    if scheduler is not None:
        raise UserError(
            "scheduler isn't used: learning rates are schedules themselves, for instance "
            "system.geometry.lr_means"
        )
    for key in options:
        if key not in ("name", "args", "params"):
            raise unknown("key system.optimizer.", key, ("name", "args", "params"))
    _check_rates(options.get("params") or {})
    name, arguments = options.get("name", "Adam"), options.get("args") or {}
    if not isinstance(getattr(torch.optim, str(name), None), type):
        known = [name for name, value in vars(torch.optim).items() if isinstance(value, type)]
        working = [known_name for known_name in known if not _refusal({"name": known_name})]
        raise unknown("system.optimizer.name", name, working)
    if not isinstance(arguments, Mapping):
        raise UserError(f"optimizer.args: expected keys and values, got {arguments!r}")
    if error := _refusal(options):
        accepted = accepted_arguments(name)
        wrong = [unknown("argument", key, accepted) for key in arguments if key not in accepted]
        refused = [k for k, v in arguments.items() if _refusal({"name": name, "args": {k: v}})]
        where = f".args.{refused[0]}" if refused and not wrong else ""
        said = str(wrong[0] if wrong else error).splitlines()[0]
        raise UserError(f"optimizer{where}: {name} doesn't accept this: {said}") from error


def _refusal(options: Mapping[str, Any]) -> Optional[Exception]:
    """Make the optimiser of some parameters, and a step; return the error if it can't be done."""
    parameters = [torch.zeros(1, requires_grad=True) for _ in range(2)]
    for parameter in parameters:
        parameter.grad = torch.zeros_like(parameter)
    try:
        optimizer = make_optimizer(options, [{"params": [p], "lr": 0.0} for p in parameters])
        capturable = (options.get("args") or {}).get("capturable")
        if not (capturable and get_device().type == "cuda"):
            optimizer.step()  # on the CPU, which would refuse what a GPU takes
    except Exception as error:  # of many types
        return error
    return None


def _check_rates(params: Any) -> None:
    if not isinstance(params, Mapping):
        raise UserError(f"optimizer.params: expected parts and their lr, got {params!r}")
    for name, options in params.items():
        if name == "geometry":
            raise UserError("optimizer.params.geometry: its rates are system.geometry.lr_*")
        if name not in PARTS:
            raise unknown("key system.optimizer.params.", name, PARTS)
        if not isinstance(options, Mapping) or set(options) != {"lr"}:
            raise UserError(f"optimizer.params.{name}: expected {{lr: ...}}, got {options!r}")
        RATE[RULE](f"optimizer.params.{name}.lr", options["lr"])


class PartRates:
    """Learning rates of the parts beside the geometry; ``options`` is ``system.optimizer``."""

    def __init__(self, options: Any) -> None:
        params = (options.get("params") or {}).items()
        self.rates = {f"{name}.parameters": parse_schedule(part["lr"]) for name, part in params}

    def groups(self, system: Any) -> Groups:
        """Return the groups of our background, and of other packages' parts that have parameters;
        raise UserError for parameters without a learning rate, and for a rate without parameters.
        """
        geometry = system.geometry
        for name, parameter in _without_group(geometry, geometry.parameter_groups()).items():
            if parameter.numel():
                kind = type(geometry).__name__
                raise UserError(
                    f"{kind} has the parameter {name} without a learning rate: define "
                    f"{kind}.parameter_groups, which adds {{'params': [...], 'name': {name!r}, "
                    "'lr': ...} to those of super()"
                )
        return [group for name in PARTS for group in self._groups_of(name, getattr(system, name))]

    def _groups_of(self, name: str, part: Optional[torch.nn.Module]) -> Groups:
        ours, own = isinstance(part, FlatBackground), f"{name}.parameters"
        groups = part.parameter_groups() if ours else []
        if ours:
            self.rates["background"] = parse_schedule(part.cfg.lr)
        trained = [] if part is None else [*_without_group(part, groups).values()]
        if trained and own not in self.rates:
            raise UserError(
                f"{type(part).__name__} has parameters without a learning rate: set "
                f"system.optimizer.params.{name}.lr; 0 leaves them as they are"
            )
        if own in self.rates and not trained:
            found = f"{type(part).__name__} has no parameters that need this rate"
            hint = ": its rate is system.background.lr" if ours else ""
            raise UserError(f"system.optimizer.params.{name}: {found}{hint}")
        return [*groups, {"params": trained, "name": own, "lr": 0.0}] if trained else groups

    def set(self, optimizer: torch.optim.Optimizer, epoch: int, step: int) -> None:
        """Set the learning rates of the groups of :meth:`groups`."""
        for group in optimizer.param_groups:
            if group.get("name") in self.rates:
                group["lr"] = C(self.rates[group["name"]], epoch, step)


def _without_group(part: torch.nn.Module, groups: Groups) -> dict[str, torch.nn.Parameter]:
    """Return the trainable parameters of a part that are in none of these groups."""
    grouped = {id(parameter) for group in groups for parameter in group["params"]}
    return {
        name: parameter
        for name, parameter in part.named_parameters()
        if parameter.requires_grad and id(parameter) not in grouped
    }
