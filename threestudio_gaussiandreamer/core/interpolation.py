"""Escape text that OmegaConf would otherwise read as an interpolation."""

import re
from typing import Any


def escape(value: Any) -> Any:
    """Escape each ``${`` in a string, or in the strings of nested lists and dicts, so that
    OmegaConf resolves it to the original text.
    """
    if isinstance(value, str):
        # Backslashes are literal except right before "${". The lookbehind makes a run of them match
        # from its start only, which keeps the search linear in its length.
        return re.sub(r"(?<!\\)(\\*)\$\{", lambda match: 2 * match[1] + r"\${", value)
    if isinstance(value, dict):
        return {key: escape(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(escape(item) for item in value)
    return value
