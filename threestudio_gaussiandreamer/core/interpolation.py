"""Text that OmegaConf must not read as an interpolation."""

import re
from typing import Any


def escape(value: Any) -> Any:
    """``value`` such that OmegaConf gives the same text back: each ``${`` of a string, also inside
    lists and dicts, escaped.
    """
    if isinstance(value, str):
        # Backslashes mean themselves, except right before "${"; the look behind lets a row of them
        # be tried from its start only, which takes linear time.
        return re.sub(r"(?<!\\)(\\*)\$\{", lambda match: 2 * match[1] + r"\${", value)
    if isinstance(value, dict):
        return {key: escape(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(escape(item) for item in value)
    return value
