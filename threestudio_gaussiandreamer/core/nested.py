"""Nested dataclasses in a part's ``Config``: keys that a YAML doesn't give keep their defaults."""

import dataclasses
from collections.abc import Mapping
from typing import Any


def adopt_nested(config: Any) -> None:
    """Convert mappings in dataclass-typed fields to those dataclasses; call it from
    ``__post_init__``.

    The host builds ``Config(**mapping)``, which leaves a nested mapping as it is, without the
    defaults of its missing keys.

    Raises:
        TypeError: a key that the dataclass doesn't have.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(field.type) and isinstance(value, Mapping):
            setattr(config, field.name, field.type(**value))
