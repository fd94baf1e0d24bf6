"""``--typecheck``: every call of this package is checked against the array shapes and types in its
annotations.

jaxtyping's import hook decorates each function with :func:`check` and binds the names of
dimensions. Only arrays are checked: configurations hold OmegaConf's lists and mappings where an
annotation says ``list``, and an int may be given for a float."""

import functools
import inspect
import types
import typing
from collections.abc import Callable
from typing import Any

import jaxtyping


def install() -> None:
    """Check the functions of all modules of this package that are imported after this call."""
    jaxtyping.install_import_hook(__package__.partition(".")[0], f"{__name__}.check")


def check(function: Callable) -> Callable:
    """Wrap ``function`` so that it raises TypeError when an array among its arguments or its result
    doesn't match the annotation.
    """
    signature = inspect.signature(function)

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        bound = signature.bind(*args, **kwargs)
        for name, value in bound.arguments.items():
            annotation = signature.parameters[name].annotation
            _require(value, annotation, f"{function.__qualname__}: {name}")
        result = function(*args, **kwargs)
        _require(result, signature.return_annotation, f"{function.__qualname__}: result")
        return result

    return checked


def _require(value: Any, annotation: Any, what: str) -> None:
    if not matches(value, annotation):
        found = f"{getattr(value, 'dtype', '')} {tuple(getattr(value, 'shape', ()))}"
        raise TypeError(f"{what} is {type(value).__name__} {found}; expected {annotation}")


def matches(value: Any, annotation: Any) -> bool:
    """Return whether ``value`` matches its annotation; True if that contains no array type."""
    if not _speaks_of_arrays(annotation):
        return True
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        arrays = [argument for argument in arguments if _speaks_of_arrays(argument)]
        others = tuple(typing.get_origin(a) or a for a in arguments if a not in arrays)
        known = any(other is Any or isinstance(value, other) for other in others)
        return known or any(matches(value, argument) for argument in arrays)
    if origin is tuple and Ellipsis not in arguments:
        same_length = isinstance(value, tuple) and len(value) == len(arguments)
        return same_length and all(map(matches, value, arguments))
    return isinstance(value, annotation) if inspect.isclass(annotation) else True


def _speaks_of_arrays(annotation: Any) -> bool:
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return any(map(_speaks_of_arrays, typing.get_args(annotation)))
