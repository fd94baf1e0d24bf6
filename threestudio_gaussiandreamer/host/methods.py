"""Check that the class of a user's part has what is used of it."""

import inspect
from typing import Any

from ..core.errors import UserError


def find_method(owner: type, name: str) -> Any:
    """Return what a class or its bases define under a name, but not its metaclass; None if nothing,
    if it is abstract, or if it is the ``forward`` with which ``nn.Module`` says that there is none.
    """
    found = next((vars(base)[name] for base in owner.__mro__ if name in vars(base)), None)
    is_missing = getattr(found, "__name__", "") == "_forward_unimplemented"
    return None if is_missing or getattr(found, "__isabstractmethod__", False) else found


def require_method(owner: type, name: str, *parameters: str, more: bool = False) -> None:
    """Raise UserError unless the instances of a class have a method that takes positional arguments
    of these names; with ``more`` it may need further ones.
    """
    call = f"{name}({', '.join([*parameters, *['...'] * more])})"
    found, method = find_method(owner, name), getattr(owner, name, None)
    if found is None or not callable(method):
        raise UserError(f"{owner.__name__} has no {call}")
    # not bound already, nor an object that an instance doesn't bind, such as functools.partial
    binds = hasattr(found, "__get__") and not isinstance(found, (classmethod, staticmethod))
    signature = inspect.signature(method)
    try:
        bind = signature.bind_partial if more else signature.bind
        bind(*["self"] * binds, *parameters)
    except TypeError as error:
        said = f"{name}{signature}, which is called as {call}: {error}"
        raise UserError(f"{owner.__name__} has {said}") from error


def require_class_method(owner: type, name: str) -> None:
    """Raise UserError if a class has a method of this name that needs an instance."""
    if inspect.isfunction(find_method(owner, name)):
        raise UserError(f"{owner.__name__}.{name} needs @classmethod above it")


def require_dataclass(owner: Any) -> None:
    """Raise UserError for options in ``Config`` that would be ignored: no decorator, no type."""
    config, types = owner.Config, inspect.get_annotations(owner.Config)
    known = types if "__dataclass_fields__" in vars(config) else ()
    names = [
        name
        for name, value in {**dict.fromkeys(types), **vars(config)}.items()
        if not (name in known or name.startswith("_") or name.isupper())
        and not (callable(value) or hasattr(value, "__get__"))
    ]
    if names or not hasattr(config, "__dataclass_fields__"):
        write = f"@dataclass above its class line, and {[*names, 'color'][0]}: float = ..."
        said = f"is no dataclass with typed options: write {write}, for instance"
        raise UserError(f"{owner.__name__}.Config {said}")
