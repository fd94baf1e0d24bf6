"""A mapping with values that are computed when they are first read."""

from collections import UserDict
from collections.abc import Callable, Mapping
from typing import Any


class LazyMapping(UserDict):
    """Values by name; ``later`` are functions of no argument, each called at most once."""

    def __init__(self, values: Mapping[str, Any], later: Mapping[str, Callable[[], Any]]) -> None:
        self.data, self.later = {**values, **later}, {*later}

    def __getitem__(self, name: str) -> Any:
        if name in self.later:
            self[name] = self.data[name]()
        return self.data[name]

    def __setitem__(self, name: str, value: Any) -> None:
        self.later.discard(name)
        self.data[name] = value
