"""Options in groups: a dataclass inside a part's ``Config`` keeps its defaults when a YAML gives
only some of its keys.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any


def adopt_nested(config: Any) -> None:
    """Turn mappings given for dataclass-typed fields into those dataclasses; call it from
    ``__post_init__``.

    The host builds ``Config(**mapping)``, which would leave a plain mapping, without the defaults
    of the keys that it lacks.

    Raises:
        TypeError: a key that the dataclass doesn't have.
    """
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if dataclasses.is_dataclass(field.type) and isinstance(value, Mapping):
            setattr(config, field.name, field.type(**value))
