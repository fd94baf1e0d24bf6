"""``--typecheck``: every call of this package is checked against the array shapes and types in its
annotations. jaxtyping's import hook decorates each function with :func:`check` and binds the names
of dimensions. Only arrays are checked: an int may be given for a float, for instance."""

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
    """Let ``function`` raise TypeError when an array doesn't match its annotation."""
    signature = inspect.signature(function)

    def require(value: Any, annotation: Any, what: str) -> None:
        if not matches(value, annotation):
            kind = f"{type(value).__name__} {getattr(value, 'dtype', '')}"
            found = f"{function.__qualname__}: {what} is {kind} {getattr(value, 'shape', ())}"
            raise TypeError(f"{found}; expected {annotation}")

    @functools.wraps(function)
    def checked(*args: Any, **kwargs: Any) -> Any:
        for name, value in signature.bind(*args, **kwargs).arguments.items():
            require(value, signature.parameters[name].annotation, name)
        result = function(*args, **kwargs)
        require(result, signature.return_annotation, "result")
        return result

    return checked


def matches(value: Any, annotation: Any) -> bool:
    """Return whether ``value`` matches its annotation; True if that contains no array type."""
    if not _speaks_of_arrays(annotation):
        return True
    origin, arguments = typing.get_origin(annotation), typing.get_args(annotation)
    if origin in (typing.Union, types.UnionType):
        others = (typing.get_origin(a) or a for a in arguments if not _speaks_of_arrays(a))
        known = any(other is Any or isinstance(value, other) for other in others)
        return known or any(matches(value, a) for a in filter(_speaks_of_arrays, arguments))
    if origin is tuple and Ellipsis not in arguments:
        same_length = isinstance(value, tuple) and len(value) == len(arguments)
        return same_length and all(map(matches, value, arguments))
    return isinstance(value, annotation) if inspect.isclass(annotation) else True


def _speaks_of_arrays(annotation: Any) -> bool:
    if inspect.isclass(annotation) and issubclass(annotation, jaxtyping.AbstractArray):
        return True
    return any(map(_speaks_of_arrays, typing.get_args(annotation)))
