"""Values that change during training: ``C(value, epoch, global_step)``.

==========================================  ========================================================
``5`` or ``0.5``                            constant
``[v0, v1, end]``                           the same as ``[0, v0, v1, end]``
``[s0, v0, v1, s1]``                        v0 until s0, linear to v1 at s1, then v1
``[s0, v0, v1, s1, v2, s2, ...]``           piecewise linear through (s0, v0), (s1, v1), ...
==========================================  ========================================================

Integer end steps count optimiser steps, those written as ``10.0`` epochs. Random cameras are one
endless epoch, in threestudio too, so that with them a schedule in epochs stays at its first value.
"""

import math
from collections.abc import Mapping
from itertools import pairwise
from numbers import Real
from typing import Any, NamedTuple

from .errors import UserError
from .logs import warn

_warned: set[tuple[str, str]] = set()
FORMS = "a number, [v0, v1, end], [s0, v0, v1, s1] or [s0, v0, v1, s1, v2, s2, ...]"


class Schedule(NamedTuple):
    """Knots of a piecewise linear function; ``steps`` strictly increasing."""

    steps: list[float]
    values: list[float]
    in_epochs: bool


def C(value: Any, epoch: int, global_step: int) -> float:
    """Evaluate a schedule, in one of the forms above or parsed, which is faster, at a step of
    training; raise UserError if it is none.
    """
    steps, values, in_epochs = parse_schedule(value)
    now = epoch if in_epochs else global_step
    if now <= steps[0]:
        return values[0]
    for i in range(1, len(steps)):
        if now < steps[i]:
            t = (now - steps[i - 1]) / (steps[i] - steps[i - 1])
            return values[i - 1] + (values[i] - values[i - 1]) * t
    return values[-1]


def validate_schedule(value: Any, name: str = "the schedule") -> Any:
    """Return ``value`` if it is a schedule; else raise UserError, which begins with ``name``."""
    schedule = parse_schedule(value, name)
    # once for the part and the launcher, which call the option by its name and by its path
    if schedule.in_epochs and (key := (name.rpartition(".")[2], str(value))) not in _warned:
        _warned.add(key)
        warn(
            f"{name}: its end steps have decimal points and count epochs; random cameras are one "
            "endless epoch, so that it stays at its first value: write whole numbers to count steps"
        )
    return value


def parse_schedule(value: Any, name: str = "the schedule") -> Schedule:
    """Convert a number, list, tuple or ListConfig to the knots of a schedule; a parsed one is kept.
    Raise UserError for a wrong length, what isn't a finite number, or steps that don't increase.
    """
    if isinstance(value, Schedule):
        return value
    # OmegaConf's list is neither list nor tuple, but a sequence of plain numbers when iterated
    is_list = hasattr(value, "__len__") and not isinstance(value, (str, bytes, Mapping))
    knots = list(value) if is_list else [value]
    if len(knots) == 3:
        knots = [0, *knots]
    if not all(map(_is_finite, knots)):
        problem = ", which isn't made of finite numbers" if is_list else ""
    elif not is_list:
        return Schedule([0], knots, in_epochs=False)
    elif len(knots) < 4 or len(knots) % 2:
        problem = f", of {len(knots)} elements"
    else:
        # the first pair is (step, value), all later pairs are (value, step)
        steps, values, ends = [knots[0], *knots[3::2]], [knots[1], *knots[2::2]], knots[3::2]
        kinds = {isinstance(end, float) for end in ends}
        if any(later <= earlier for earlier, later in pairwise(steps)):
            problem = ", whose steps don't increase (for a hard switch write [500, v0, v1, 501])"
        elif len(kinds) > 1:
            problem = ", which mixes integer end steps (optimiser steps) and decimal ones (epochs)"
        elif broken := [end for end in ends if end != int(end)]:
            problem = f", whose end step {broken[0]:g} is no whole number of steps or epochs"
        else:
            return Schedule(steps, values, in_epochs=True in kinds)
    raise UserError(f"{name} is {value!r}{problem}; expected {FORMS}")


def _is_finite(value: Any) -> bool:
    return isinstance(value, Real) and not isinstance(value, bool) and math.isfinite(value)
