"""Ranges of options, declared at the fields of a part's ``Config`` and read by one walker.

    scale: float = field(default=1.0, metadata=positive())
    mode: str = field(default="fixed", metadata=one_of(MODES))

:func:`check_options` checks every field, then calls ``Config.check(cfg)`` where the class has one:
a static method for rules across fields, which raises UserError with a message that begins with the
option's name; the walker prepends the path of the section. None is accepted where it is the default
of a field. Every number must be representable in float32 or int64."""

import dataclasses
import string
from collections.abc import Callable, Collection, Mapping, Sequence
from types import MappingProxyType, SimpleNamespace
from typing import Any

from .errors import UserError, unknown
from .schedule import parse_schedule, validate_schedule

RULE = "option"
"""The key of a field's rule in its metadata."""
SCHEDULE = "schedule"
"""The key in the metadata of fields that are schedules."""
FLOAT32_MAX = 3.4028234663852886e38
FLOAT32_TINY = 1.1754943508222875e-38
"""Smallest normal float32: smaller positive options could be rounded to zero."""
NAME_CHARACTERS = string.ascii_letters + string.digits + "_"
INT64_MAX = 2**63 - 1
SHOWN = 80
"""Maximum length of a value in a message, characters."""

Rule = dict[str, Any]
"""Metadata of a field."""


# -- rules -----------------------------------------------------------------------------------------


def rule(check: Callable[[str, Any], None]) -> Rule:
    """Return field metadata with ``check(path, value)``, which raises UserError for a bad value."""
    return {RULE: check}


def satisfies(expected: str, holds: Callable[[Any], bool]) -> Rule:
    """Accept values for which ``holds`` is true; ``expected`` describes them in the message."""

    def check(path: str, value: Any) -> None:
        if not holds(value):
            raise UserError(f"{path}: expected {expected}, got {shown(value)}")

    return rule(check)


def positive(unit: str = "", most: float = FLOAT32_MAX) -> Rule:
    """Accept numbers that are above 0, also after conversion to float32, and at most ``most``."""
    bound = "" if most == FLOAT32_MAX else f" and at most {most:g}"
    return satisfies(
        f"a number above 0{bound}{_with_unit(unit)}", lambda v: is_positive(v) and v <= most
    )


def at_least(low: float, unit: str = "") -> Rule:
    """Accept numbers of ``low`` or more."""
    return satisfies(f"{low:g} or more{_with_unit(unit)}", lambda v: is_number(v) and v >= low)


def in_range(low: float, high: float, unit: str = "") -> Rule:
    """Accept numbers from ``low`` to ``high``, both included."""
    return satisfies(
        f"a number from {low:g} to {high:g}{_with_unit(unit)}",
        lambda v: is_number(v) and low <= v <= high,
    )


def between(low: float, high: float, unit: str = "") -> Rule:
    """Accept numbers between ``low`` and ``high``, both excluded."""
    return satisfies(
        f"a number between {low:g} and {high:g}{_with_unit(unit)}",
        lambda v: is_number(v) and low < v < high,
    )


def one_of(choices: Collection[str] | Callable[[], Collection[str]]) -> Rule:
    """Accept names among ``choices``, which may be a function that returns them."""

    def check(path: str, value: Any) -> None:
        known = choices() if callable(choices) else choices
        if value not in known:
            raise unknown(path, value, known)

    return rule(check)


def schedule(min: float = -FLOAT32_MAX, max: float = FLOAT32_MAX) -> Rule:
    """Accept numbers and schedules (``core/schedule.py``) with values from ``min`` to ``max``."""

    def check(path: str, value: Any) -> None:
        for number in parse_schedule(validate_schedule(value, path)).values:
            if not min <= number <= max:
                bound = f"{min:g} or more" if number < min else f"{max:g} or less"
                raise UserError(f"{path}: expected values of {bound}, got {number:g}")

    return rule(check) | {SCHEDULE: True}


def interval(low: float = -FLOAT32_MAX, high: float = FLOAT32_MAX, what: str = "numbers") -> Rule:
    """Accept pairs [a, b] with ``low`` <= a <= b <= ``high``; ``what`` describes the numbers."""
    bounds = [f"from {low:g}"] * (low > -FLOAT32_MAX) + [f"to {high:g}"] * (high < FLOAT32_MAX)
    return satisfies(
        " ".join([f"[low, high], {what}", *bounds, "with low <= high"]),
        lambda v: is_numbers(v, 2) and low <= v[0] <= v[1] <= high,
    )


def each(item: Rule) -> Rule:
    """Accept lists in which every item satisfies the rule ``item``."""

    def check(path: str, values: Any) -> None:
        if not is_list(values):
            raise UserError(f"{path}: expected a list, got {shown(values)}")
        for i, value in enumerate(values):
            item[RULE](f"{path}[{i}]", value)

    return rule(check)


def required(purpose: str) -> Rule:
    """Accept non-empty text; ``purpose`` is the message for empty text."""

    def check(path: str, value: Any) -> None:
        if not value:
            raise UserError(f"{path}: {purpose}")

    return rule(check)


def _with_unit(unit: str) -> str:
    return f" ({unit})" if unit else ""


# -- values ----------------------------------------------------------------------------------------


def is_number(value: Any) -> bool:
    """Return whether ``value`` is a finite number within float32's range."""
    return (
        isinstance(value, (int, float))
        and not isinstance(value, bool)
        and -FLOAT32_MAX <= value <= FLOAT32_MAX
    )


def is_positive(value: Any) -> bool:
    """Return whether ``value`` is a number above 0, also after conversion to float32."""
    return is_number(value) and value >= FLOAT32_TINY


def is_whole(value: Any) -> bool:
    """Return whether ``value`` is an int (not a bool) that fits into 64 bits."""
    return isinstance(value, int) and not isinstance(value, bool) and abs(value) <= INT64_MAX


def is_list(value: Any) -> bool:
    """Return whether ``value`` is a list, a tuple or OmegaConf's list."""
    return isinstance(value, Sequence) and not isinstance(value, (str, bytes))


def is_numbers(value: Any, count: int) -> bool:
    """Return whether ``value`` is a list of ``count`` numbers."""
    return is_list(value) and len(value) == count and all(map(is_number, value))


def shown(value: Any) -> str:
    """Format ``value`` for a message, shortened to ``SHOWN`` characters."""
    text = (
        _digits(value) if isinstance(value, int) else repr(list(value) if is_list(value) else value)
    )
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def _digits(value: int) -> str:
    """Format an integer; Python raises an error for one of more than 4300 digits."""
    return repr(value) if value.bit_length() < 256 else f"an integer of {value.bit_length()} bits"


def require_representable(path: str, value: Any) -> None:
    """Check every number in a value.

    Raises:
        UserError: an int beyond 64 bits, or a float that isn't finite in float32.
    """
    if isinstance(value, Mapping):
        for key in value:
            require_representable(f"{path}.{key}", value[key])
    elif is_list(value):
        for i, item in enumerate(value):
            require_representable(f"{path}[{i}]", item)
    elif isinstance(value, int) and abs(value) > INT64_MAX:
        raise UserError(f"{path}: expected a whole number of at most 64 bits, got {shown(value)}")
    elif isinstance(value, float) and not is_number(value):
        raise UserError(f"{path}: expected a finite number that float32 can hold, got {value}")


# -- the walker ------------------------------------------------------------------------------------


def check_options(config_class: type, cfg: Any, prefix: str = "") -> None:
    """Check the options ``cfg`` against the rules that the fields of ``config_class`` declare.

    Args:
        cfg: an instance of the dataclass, or OmegaConf's mapping of it.
        prefix: prepended to the names of options in messages, such as "system.geometry." or "--".

    Raises:
        UserError: the first value out of range; the message begins with its path.
    """
    for option in dataclasses.fields(config_class):
        path, value = prefix + _written(option.name, prefix), getattr(cfg, option.name)
        if dataclasses.is_dataclass(option.type):
            check_options(option.type, value, f"{path}.")
            continue
        require_representable(path, value)
        if RULE in option.metadata and not (value is None and option.default is None):
            option.metadata[RULE](path, value)
    if hasattr(config_class, "check"):
        try:
            config_class.check(cfg)
        except ValueError as error:  # UserError is one
            names = {option.name for option in dataclasses.fields(config_class)}
            raise UserError(_located(str(error), prefix, names)) from error


def _written(name: str, prefix: str) -> str:
    """Return the name of an option as users write it: on a command line with hyphens."""
    return name.replace("_", "-") if prefix == "--" else name


def checked_options(config_class: type, cfg: Any, prefix: str = "") -> SimpleNamespace:
    """Check the options, see :func:`check_options`, and copy them to plain attributes.

    Parts read these in every step: reading one value from OmegaConf takes up to 0.1 ms.
    Nested sections are namespaces too, lists are lists, and schedules are parsed, for ``C``.
    """
    check_options(config_class, cfg, prefix)
    return _copied_section(config_class, cfg)


def require_defaults(
    config_class: type,
    cfg: Any,
    names: Collection[str],
    reason: str,
    *,
    prefix: str = "",
    neutral: Mapping[str, Any] = MappingProxyType({}),
) -> None:
    """Check that options without effect are at their defaults.

    Args:
        names: the options that have no effect.
        reason: when that is so, such as "with pose=A".
        prefix: see :func:`check_options`.
        neutral: values by name that do nothing, where the default does something.

    Raises:
        UserError: one of them has another value.
    """
    for option in dataclasses.fields(config_class):
        unset = (option.default, neutral.get(option.name, option.default))
        if option.name in names and getattr(cfg, option.name) not in unset:
            raise UserError(
                f"{prefix}{option.name} has no effect {reason}: leave it at {option.default}"
            )


def _copied_section(config_class: type, cfg: Any) -> SimpleNamespace:
    options = dataclasses.fields(config_class)
    return SimpleNamespace(**{o.name: _copied_option(o, getattr(cfg, o.name)) for o in options})


def _copied_option(option: dataclasses.Field, value: Any) -> Any:
    if dataclasses.is_dataclass(option.type):
        return _copied_section(option.type, value)
    if SCHEDULE in option.metadata and value is not None:
        return parse_schedule(value)
    return _copied(value)


def _copied(value: Any) -> Any:
    """Copy OmegaConf's containers to lists and dictionaries."""
    if isinstance(value, Mapping):
        return {key: _copied(value[key]) for key in value}
    return [_copied(item) for item in value] if is_list(value) else value


def _located(message: str, prefix: str, names: Collection[str]) -> str:
    """Prepend the option's path to ``message``, unless the message begins with it already."""
    if message.startswith(prefix):
        return message
    begins_with_option = message[: len(message) - len(message.lstrip(NAME_CHARACTERS))] in names
    return prefix + message if begins_with_option else f"{prefix.rstrip('.')}: {message}"
