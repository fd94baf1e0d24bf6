"""Check that the class of a user's part has what is used of it."""

import inspect
from typing import Any, Optional

from .errors import UserError


def find_method(owner: type, name: str) -> Any:
    """Return what a class or its bases define under a name; None if nothing or if it is abstract.

    Unlike ``getattr``, this doesn't find ``__call__`` of the metaclass.
    """
    found = next((vars(base)[name] for base in owner.__mro__ if name in vars(base)), None)
    return None if getattr(found, "__isabstractmethod__", False) else found


def require_method(owner: type, name: str, *parameters: str, more: bool = False) -> None:
    """Check that the instances of a class have a method that takes some positional arguments.

    Args:
        parameters: names of the arguments, without ``self``.
        more: the method may need further arguments.

    Raises:
        UserError: there is none, it is abstract, or it takes other arguments.
    """
    given = ", ".join([*parameters, *(["..."] if more else [])])
    call, found = f"{name}({given})", find_method(owner, name)
    method = getattr(owner, name, None)
    if found is None or not callable(method):
        raise UserError(f"{owner.__name__} has no {call}")
    # bound already, or an object that an instance doesn't bind, such as functools.partial
    takes_no_self = isinstance(found, (classmethod, staticmethod)) or not hasattr(found, "__get__")
    try:
        signature = inspect.signature(method)
    except ValueError:  # of some builtin functions
        return
    bind = signature.bind_partial if more else signature.bind
    try:
        bind(*(parameters if takes_no_self else ("self", *parameters)))
    except TypeError as error:
        raise UserError(
            f"{owner.__name__} has {name}{signature}, which is called as {call}: {error}"
        ) from error


def require_class_method(owner: type, name: str) -> None:
    """Raise UserError if a class has a method of this name that needs an instance."""
    if inspect.isfunction(find_method(owner, name)):
        raise UserError(f"{owner.__name__}.{name} needs @classmethod above it")


def error_of_configure(error: Exception) -> Optional[UserError]:
    """Return the error that names the ``configure`` of a part without ``super().configure``, if
    that is why an attribute is missing; else None.
    """
    part, name = getattr(error, "obj", None), getattr(error, "name", None)
    if not isinstance(error, AttributeError) or isinstance(part, type):
        return None
    found = [vars(base)["configure"] for base in type(part).__mro__ if "configure" in vars(base)]
    codes = [call.__code__ for call in found if inspect.isfunction(call)]
    names = [(*code.co_names, *code.co_consts) for code in codes]
    # set by the configure of a base class, also as a buffer, or a property that reads what it sets
    missing = any(name in known for known in names[1:]) or hasattr(type(part), name or "")
    if not names or "configure" in names[0] or not missing:
        return None
    return UserError(
        f"{found[0].__qualname__} must call super().configure with the arguments that it gets: "
        f"{type(part).__name__} has no {name!r}"
    )


def _is_untyped(config: type, name: str, value: Any) -> bool:
    """Return whether a member of a class of options looks like one without a type."""
    is_member = name.startswith("_") or callable(value) or hasattr(value, "__get__")
    return not (is_member or name.isupper() or name in inspect.get_annotations(config))


def require_dataclass(owner: Any) -> None:
    """Check the options of a part, ``Config``.

    Raises:
        UserError: it isn't a dataclass, lacks the decorator, without which options that a subclass
            adds are ignored, has an option without a type, which is ignored too, or isn't derived
            from that of the part's base class.
    """
    config, bases = owner.Config, getattr(owner.Config, "__dataclass_fields__", None)
    own = vars(config)
    defined = inspect.get_annotations(config).keys() | (own.keys() & (bases or {}).keys())
    if bases is None or ("__dataclass_fields__" not in own and defined):
        raise UserError(
            f"{owner.__name__}.Config is no dataclass: write @dataclass above its class line"
        )
    if untyped := [name for name, value in own.items() if _is_untyped(config, name, value)]:
        raise UserError(
            f"{owner.__name__}.Config.{untyped[0]} has no type: write {untyped[0]}: "
            f"{type(own[untyped[0]]).__name__} = ..."
        )
    for base in owner.__mro__:
        missing = getattr(getattr(base, "Config", None), "__dataclass_fields__", {}).keys() - bases
        if missing:
            raise UserError(
                f"{owner.__name__}.Config lacks {', '.join(sorted(missing))}: derive it from "
                f"{base.__name__}.Config"
            )
