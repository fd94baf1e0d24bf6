"""Options: plain dataclasses, filled and checked once by :func:`parse_structured`.

    scale: float = field(default=1.0, metadata=positive())
    mode: str = field(default="fixed", metadata=one_of(MODES))

Names and types are those of the fields; ranges are declared in their metadata. A static method
``Config.check(cfg)`` has rules across fields: it raises UserError with a message that begins with
the option's name, to which the path of the section is prepended. None is accepted where it is the
default of a field. Every number must be representable in float32 or int64."""

import dataclasses
import os
import re
import types
import typing
from collections.abc import Callable, Collection, Mapping, MutableMapping, Sequence
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

from .errors import UserError, unknown
from .logs import info, warn
from .schedule import parse_schedule, validate_schedule

RULE = "option"
"""The key of a field's rule in its metadata: ``check(path, value)``, which raises UserError."""
SCALARS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}
SWITCHES = dict.fromkeys(("true", "yes", "y", "on", "1"), True)
SWITCHES |= dict.fromkeys(("false", "no", "n", "off", "0"), False)
FLOAT32_MAX, FLOAT32_TINY = 3.4028234663852886e38, 1.1754943508222875e-38
"""Largest and smallest normal float32: smaller positive options could be rounded to zero."""
INT64_MAX = 2**63 - 1
CGROUP_LIMIT = Path("/sys/fs/cgroup/memory.max")

Rule = dict[str, Any]
"""Metadata of a field."""


# -- rules -----------------------------------------------------------------------------------------


def satisfies(expected: str, holds: Callable[[Any], bool]) -> Rule:
    """Accept values for which ``holds`` is true; ``expected`` describes them in the message."""

    def check(path: str, value: Any) -> None:
        if not holds(value):
            raise wrong(path, expected, value)

    return {RULE: check}


def positive(unit: str = "", most: float = FLOAT32_MAX) -> Rule:
    """Accept numbers that are above 0, also after conversion to float32, and at most ``most``."""
    bound = "" if most == FLOAT32_MAX else f" and at most {most:g}"
    return _numbers(f"a number above 0{bound}", unit, lambda v: FLOAT32_TINY <= v <= most)


def at_least(low: float, unit: str = "") -> Rule:
    """Accept numbers of ``low`` or more."""
    return _numbers(f"{low:g} or more", unit, lambda v: v >= low)


def in_range(low: float, high: float, unit: str = "") -> Rule:
    """Accept numbers from ``low`` to ``high``, both included."""
    return _numbers(f"a number from {low:.10g} to {high:.10g}", unit, lambda v: low <= v <= high)


def between(low: float, high: float, unit: str = "") -> Rule:
    """Accept numbers between ``low`` and ``high``, both excluded."""
    return _numbers(f"a number between {low:g} and {high:g}", unit, lambda v: low < v < high)


def _numbers(expected: str, unit: str, holds: Callable[[Any], bool]) -> Rule:
    expected += f" ({unit})" if unit else ""
    return satisfies(expected, lambda value: is_number(value) and holds(value))


def one_of(choices: Collection[str] | Callable[[], Collection[str]]) -> Rule:
    """Accept names among ``choices``, which may be a function that returns them."""

    def check(path: str, value: Any) -> None:
        known = choices() if callable(choices) else choices
        if value not in known:
            raise unknown(path, value, known)

    return {RULE: check}


def schedule(min: float = -FLOAT32_MAX, max: float = FLOAT32_MAX) -> Rule:
    """Accept numbers and schedules (``core/schedule.py``) with values from ``min`` to ``max``."""

    def check(path: str, value: Any) -> None:
        for number in parse_schedule(validate_schedule(value, path)).values:
            if not min <= number <= max:
                bound = f"{min:g} or more" if number < min else f"{max:g} or less"
                raise wrong(path, f"values of {bound}", number)

    return {RULE: check}


def interval(low: float = -FLOAT32_MAX, high: float = FLOAT32_MAX, what: str = "numbers") -> Rule:
    """Accept pairs [a, b] with ``low`` <= a <= b <= ``high``; ``what`` describes the numbers."""
    bounds = [f"from {low:g}"] * (low > -FLOAT32_MAX) + [f"to {high:g}"] * (high < FLOAT32_MAX)
    expected = " ".join([f"[low, high], {what}", *bounds, "with low <= high"])
    return satisfies(expected, lambda v: is_numbers(v, 2) and low <= v[0] <= v[1] <= high)


def each(item: Rule) -> Rule:
    """Accept lists in which every item satisfies the rule ``item``."""

    def check(path: str, values: Any) -> None:
        for i, value in enumerate(values):
            item[RULE](f"{path}[{i}]", value)

    return {RULE: check}


def required(purpose: str) -> Rule:
    """Accept non-empty text; ``purpose`` is the message for empty text."""

    def check(path: str, value: Any) -> None:
        if not value:
            raise UserError(f"{path}: {purpose}")

    return {RULE: check}


def count_of(things: str, low: int, bytes_each: int) -> Rule:
    """Return a rule for counts from ``low`` on, limited by memory: each takes ``bytes_each``."""

    def check(path: str, value: Any) -> None:
        if not is_whole(value) or value < low:
            raise wrong(path, f"{low} or more {things}", value)
        require_memory(path, bytes_each * value, f"{value} {things}")

    return {RULE: check}


# -- values ----------------------------------------------------------------------------------------


def is_number(value: Any) -> bool:
    """Return whether ``value`` is a finite number within float32's range."""
    return isinstance(value, (int, float)) and type(value) is not bool and abs(value) <= FLOAT32_MAX


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
    """Format ``value`` for a message, as in YAML if it is null, at most 80 characters."""
    if value is None:
        return "null"
    if isinstance(value, int) and value.bit_length() >= 256:  # repr has a limit
        return f"an integer of {value.bit_length()} bits"
    text = repr(list(value) if is_list(value) else value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def wrong(path: str, expected: str, value: Any) -> UserError:
    """Make the error for a value that isn't what is ``expected``."""
    return UserError(f"{path}: expected {expected}, got {shown(value)}")


def require_representable(path: str, value: Any) -> None:
    """Raise UserError for ints beyond 64 bits and floats beyond float32, also nested ones."""
    if isinstance(value, Mapping):
        for key in value:
            require_representable(f"{path}.{key}", value[key])
    elif is_list(value):
        for i, item in enumerate(value):
            require_representable(f"{path}[{i}]", item)
    elif isinstance(value, int) and abs(value) > INT64_MAX:
        raise wrong(path, "a whole number of at most 64 bits", value)
    elif isinstance(value, float) and not is_number(value):
        raise wrong(path, "a finite number that float32 can hold", value)


# -- memory ---------------------------------------------------------------------------------------


@cache
def memory_bytes() -> int:
    """Return the bytes of the largest memory: the machine's (or its container's) or one GPU's."""
    import torch

    gpus = range(torch.cuda.device_count() if torch.cuda.is_available() else 0)
    return max([main_memory(), *(torch.cuda.get_device_properties(i).total_memory for i in gpus)])


def main_memory() -> int:
    """Return the bytes of the machine's or its container's memory, which a GPU's isn't part of."""
    try:
        total = os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, ValueError, OSError):  # not a POSIX system
        return 2**40
    limit = CGROUP_LIMIT.read_text(encoding="utf-8").strip() if CGROUP_LIMIT.is_file() else "max"
    return min(total, int(limit)) if limit.isdigit() else total


def require_memory(options: str, needed: float, what: str) -> None:
    """Raise UserError, which names the ``options`` and ``what`` ("24 pictures of 64 x 64 pixels"),
    if about ``needed`` bytes exceed :func:`memory_bytes`.
    """
    if needed > memory_bytes():
        has = f"this machine has {size_text(memory_bytes())}"
        said = f"{what} take about {size_text(needed)} of memory, and {has}; take less"
        raise UserError(f"{options}: {said}")


def size_text(count: float) -> str:
    """Format a number of bytes with a unit, such as "24 GB"."""
    for unit in ("bytes", "kB", "MB", "GB"):
        if count < 1000:
            return f"{count:.3g} {unit}"
        count /= 1000
    return f"{count:.4g} TB"


# -- from values to options -----------------------------------------------------------------------


def parse_structured(config_class: Any, values: Any = None, prefix: str = "") -> Any:
    """Make the options ``config_class`` from a mapping, or options that have been made already, and
    check names, types and ranges.

    Args:
        prefix: prepended to the names of options in messages, such as "system.geometry.".

    Raises:
        UserError: an unknown key, a value of the wrong type or out of range, or a missing one.
    """
    cfg = _filled(config_class, {} if values is None else _plain(values), prefix)
    check_options(config_class, cfg, prefix)
    return cfg


def _filled(config_class: Any, values: Any, prefix: str) -> Any:
    if isinstance(values, config_class):
        return values
    require_mapping(prefix.rstrip("."), values)
    drop_removed(config_class, values, prefix)
    options = {option.name: option for option in dataclasses.fields(config_class)}
    hints, given = typing.get_type_hints(config_class), {}
    for key, value in values.items():
        if key not in options:
            raise unknown("key", key, options, prefix=prefix)
        known = make() if callable(make := options[key].default_factory) else None
        for name in value if isinstance(known, dict) and isinstance(value, Mapping) else ():
            if known and name not in known:
                raise unknown("key", name, known, prefix=f"{prefix}{key}.")
        given[key] = _converted(prefix + key, value, hints[key])
    try:
        return config_class(**given)
    except (TypeError, ValueError) as error:  # of __post_init__, or a value is missing
        raise UserError(_located(str(error), prefix, options)) from error


def _converted(path: str, value: Any, annotation: Any) -> Any:
    """Return a value as the type of its field, to which text and whole numbers are converted."""
    kind, inner = typing.get_origin(annotation) or annotation, typing.get_args(annotation)
    if kind in (typing.Union, types.UnionType):
        choices = [choice for choice in inner if choice is not type(None)]
        if len(choices) == 1 and value is not None:
            return _converted(path, value, choices[0])
        given = float if type(value) is int and float in choices else type(value)
        if SCALARS.keys() >= {*choices} and given not in inner:
            raise wrong(path, " or ".join(SCALARS[choice] for choice in choices), value)
    elif kind in SCALARS:
        return _scalar(path, value, kind)
    elif kind in (list, tuple):
        if not is_list(value):
            raise wrong(path, "a list", value)
        items = inner
        if kind is list or not inner or Ellipsis in inner:
            items = [*inner[:1], Any][:1] * len(value)
        if len(value) != len(items):
            raise wrong(path, f"a list of {len(items)}", value)
        pairs = enumerate(zip(value, items, strict=True))
        return kind(_converted(f"{path}[{i}]", item, type_) for i, (item, type_) in pairs)
    elif dataclasses.is_dataclass(annotation):
        return _filled(annotation, value, f"{path}.")
    elif kind is dict:
        require_mapping(path, value)
        if len(inner) == 2:
            return {key: _converted(f"{path}.{key}", v, inner[1]) for key, v in value.items()}
    elif isinstance(kind, type) and isinstance(value, str):
        if issubclass(kind, Path):
            return Path(value)
        if issubclass(kind, Enum):
            if value not in kind.__members__:
                raise unknown(path, value, kind.__members__)
            return kind[value]
    return value


def _scalar(path: str, value: Any, kind: type) -> Any:
    require_representable(path, value)
    never = {int: (Mapping, bool, float), float: (Mapping, bool)}.get(kind, Mapping)
    try:
        if value in (None, "???") or is_list(value) or isinstance(value, never):  # "???": missing
            raise TypeError
        return SWITCHES[str(value).lower()] if kind is bool else kind(value)
    except (TypeError, ValueError, KeyError):
        raise wrong(path, SCALARS[kind], value) from None


def require_mapping(path: str, values: Any) -> None:
    """Raise UserError if a section isn't a mapping."""
    if not isinstance(values, Mapping):
        leaf = path.rpartition(".")[2]
        hint = f" (for none, write {leaf}: {{}})" if path else ""
        raise UserError(f"{path or 'this'} is {shown(values)}; expected keys and values{hint}")


def drop_removed(config_class: Any, values: MutableMapping, prefix: str = "") -> None:
    """Drop the options that a part had in earlier versions from its section, in place, with a line
    for each, a warning if it did something. ``Config.REMOVED`` maps their names to the value that
    did nothing, or a function that says whether one did nothing, and to what is the case now.
    """
    options = {option.name: option for option in dataclasses.fields(config_class)}
    removed = getattr(config_class, "REMOVED", {})
    for key in list(values):
        if key in removed and key not in options:  # a derived part may have its own
            (neutral, now), value = removed[key], values.pop(key)
            did_nothing = neutral(value) if callable(neutral) else value == neutral
            (info if did_nothing else warn)(f"{prefix}{key} is no option any more: {now}")
        elif key in options and dataclasses.is_dataclass(options[key].type):
            if isinstance(values[key], Mapping):
                drop_removed(options[key].type, values[key], f"{prefix}{key}.")


def _plain(value: Any) -> Any:
    """Copy mappings and lists, also OmegaConf's, to dictionaries and lists."""
    if isinstance(value, Mapping):
        return {key: _plain(value[key]) for key in value}
    if is_list(value) and not isinstance(value, tuple):
        return [_plain(item) for item in value]
    return value


def check_options(config_class: type, cfg: Any, prefix: str = "") -> None:
    """Raise UserError for the first option out of the range that its field declares; the message
    begins with ``prefix``, such as "system.geometry." or "--", and its name.
    """
    for option in dataclasses.fields(config_class):
        # as users write it: on a command line with hyphens
        written = option.name.replace("_", "-") if prefix == "--" else option.name
        path, value = prefix + written, getattr(cfg, option.name)
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


def require_defaults(
    config_class: type, cfg: Any, names: Collection[str], reason: str, prefix: str = ""
) -> None:
    """Raise UserError unless options without effect (``reason``: "with a=1") are at defaults."""
    for name in names:
        default = getattr(config_class, name, None)
        if getattr(cfg, name, default) != default:
            raise UserError(f"{prefix}{name} has no effect {reason}: leave it at {default}")


def _located(message: str, prefix: str, names: Collection[str]) -> str:
    """Prepend the option's path to ``message``, unless the message begins with it already."""
    if message.startswith(prefix):
        return message
    begins_with_option = re.match(r"\w*", message, re.ASCII)[0] in names
    return prefix + message if begins_with_option else f"{prefix.rstrip('.')}: {message}"


def escape(value: Any) -> Any:
    """Escape each ``${`` in the strings of nested lists and dicts for OmegaConf."""
    if isinstance(value, str):
        # backslashes are literal except right before "${"; the lookbehind keeps the search linear
        return re.sub(r"(?<!\\)(\\*)\$\{", lambda match: 2 * match[1] + r"\${", value)
    if isinstance(value, dict):
        return {key: escape(item) for key, item in value.items()}
    return [escape(item) for item in value] if isinstance(value, list) else value
