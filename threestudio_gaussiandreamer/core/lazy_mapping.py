"""A mapping with values that are computed when they are first read."""

from collections.abc import Callable, Iterator, Mapping, MutableMapping
from typing import Any


class LazyMapping(MutableMapping[str, Any]):
    """Values by name; ``later`` are functions of no argument, each called at most once."""

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        self._values, self._later = dict(values), dict(later)

    def __getitem__(self, name: str) -> Any:
        if name in self._later:
            self._values[name] = self._later[name]()
            del self._later[name]
        return self._values[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self._later.pop(name, None)
        self._values[name] = value

    def __delitem__(self, name: str) -> None:
        del (self._later if name in self._later else self._values)[name]

    def __contains__(self, name: object) -> bool:  # without computing it
        return name in self._values or name in self._later

    def __iter__(self) -> Iterator[str]:
        return iter([*self._values, *self._later])

    def __len__(self) -> int:
        return len(self._values) + len(self._later)
