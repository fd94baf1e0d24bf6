"""Check types of options more strictly than OmegaConf, which accepts a list in place of a number, a
tuple of any length, and NaN for a float.
"""

import dataclasses
import types
import typing
from collections.abc import Mapping, Sequence
from typing import Any

from .errors import UserError
from .options import FLOAT32_MAX, require_representable

SCALARS = {int: "a whole number", float: "a number", bool: "true or false", str: "a text"}


def check_types(config_class: Any, values: Mapping, prefix: str = "") -> None:
    """Check ``values`` against the annotations of the dataclass ``config_class``; unknown keys are
    ignored.

    Raises:
        UserError: a list or section in place of a single value or the other way round, a tuple of
            another length, or a number that isn't finite; the message begins with the key.
    """
    hints = typing.get_type_hints(config_class)
    for key, value in values.items():
        if key in hints:
            _check(f"{prefix}{key}", value, hints[key])


def _check(path: str, value: Any, annotation: Any) -> None:
    origin = typing.get_origin(annotation) or annotation
    if origin in (typing.Union, types.UnionType):
        _check_optional(path, value, typing.get_args(annotation))
    elif origin in SCALARS:
        _check_scalar(path, value, origin)
    elif origin in (list, tuple):
        _check_sequence(path, value, origin, typing.get_args(annotation))
    elif origin is dict and not isinstance(value, Mapping):
        raise UserError(f"{path}: expected keys and values, got {value!r}")
    elif dataclasses.is_dataclass(annotation) and not dataclasses.is_dataclass(value):
        if not isinstance(value, Mapping):
            raise UserError(f"{path}: expected keys and values, got {value!r}")
        check_types(annotation, value, f"{path}.")


def _check_optional(path: str, value: Any, choices: tuple) -> None:
    """Check a value of type ``Optional[X]``; other unions are left to OmegaConf."""
    inner = [choice for choice in choices if choice is not type(None)]
    if len(inner) == 1 and value is not None:
        _check(path, value, inner[0])


def _check_scalar(path: str, value: Any, kind: type) -> None:
    """Check a single value; strings are accepted for numbers, since OmegaConf converts them."""
    not_bool = kind is bool and not isinstance(value, str) and value not in (0, 1)
    if _is_container(value) or value is None or not_bool:
        raise UserError(
            f"{path}: expected {SCALARS[kind]}, got {'null' if value is None else repr(value)}"
        )
    require_representable(path, value)
    if kind is float and isinstance(value, str) and not _is_finite(value):
        raise UserError(f"{path}: expected a finite number that float32 can hold, got {value}")


def _check_sequence(path: str, value: Any, kind: type, items: tuple) -> None:
    if not _is_container(value) or isinstance(value, Mapping):
        raise UserError(f"{path}: expected a list, got {value!r}")
    if kind is list:
        items = items * len(value)
    if items and Ellipsis not in items:
        if len(value) != len(items):
            raise UserError(f"{path}: expected a list of {len(items)}, got {list(value)}")
        for i, (item, annotation) in enumerate(zip(value, items, strict=True)):
            _check(f"{path}[{i}]", item, annotation)
            if annotation in (int, float) and isinstance(
                item, str
            ):  # OmegaConf neither checks nor converts the items of a tuple
                raise UserError(f"{path}[{i}]: expected {SCALARS[annotation]}, got {item!r}")


def _is_container(value: Any) -> bool:
    return isinstance(value, (Mapping, Sequence)) and not isinstance(value, (str, bytes))


def _is_finite(text: str) -> bool:
    try:
        return -FLOAT32_MAX <= float(text) <= FLOAT32_MAX
    except ValueError:
        return True  # not a number: OmegaConf's own error is clearer
