"""Check that a user's part has the methods that are called."""

import inspect
from typing import Any

from .errors import UserError


def find_method(owner: type, name: str) -> Any:
    """Return what a class or its bases define under a name; None if nothing or if it is abstract.

    Unlike ``getattr``, this doesn't find ``__call__`` of the metaclass.
    """
    found = next((vars(base)[name] for base in owner.__mro__ if name in vars(base)), None)
    return None if getattr(found, "__isabstractmethod__", False) else found


def require_method(owner: type, name: str, *parameters: str) -> None:
    """Check that the instances of a class have a method that takes some positional arguments.

    Args:
        parameters: names of the arguments, without ``self``.

    Raises:
        UserError: there is none, it is abstract, or it takes other arguments.
    """
    call, found = f"{name}({', '.join(parameters)})", find_method(owner, name)
    if found is None:
        raise UserError(f"{owner.__name__} has no {call}")
    signature = inspect.signature(getattr(owner, name))
    # class and static methods take no self here
    arguments = ("self", *parameters) if inspect.isfunction(found) else parameters
    try:
        signature.bind(*arguments)
    except TypeError as error:
        raise UserError(
            f"{owner.__name__} has {name}{signature}, which is called as {call}: {error}"
        ) from error
