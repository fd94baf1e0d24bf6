"""The registry: parts are entered under a name by a decorator and found by that name."""

from collections.abc import Callable

from ...core.errors import UserError, unknown

_parts: dict[str, type] = {}


def register(name: str) -> Callable[[type], type]:
    """Return a decorator that enters a class, or of a regulariser the function, under ``name``;
    it raises UserError if another one has that name already.
    """

    def enter(cls: type) -> type:
        taken = _parts.get(name)
        if taken is not None and _identity(taken) != _identity(cls):
            raise UserError(
                f"the name {name!r} is taken by {_identity(taken)}: register {_identity(cls)} "
                "under another name"
            )
        _parts[name] = cls
        return cls

    return enter


def find(name: str) -> type:
    """Return the class registered as ``name``; raise UserError, with the near ones, if none is."""
    if name not in _parts:
        raise unknown("part", name, _parts)
    return _parts[name]


def names() -> list[str]:
    """Return all registered names, sorted."""
    return sorted(_parts)


def _identity(cls: type) -> str:
    # a module that is executed again makes new class objects of the same name: still the same part
    return f"{cls.__module__}.{cls.__qualname__}"
