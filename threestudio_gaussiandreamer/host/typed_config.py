"""Typed configurations of registered classes. The launcher checks them in both hosts (threestudio
and the built-in one), and the built-in host passes them to the classes."""

import copy
import re
from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from typing import Any

from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.errors import UserError, unknown
from ..core.interpolation import escape
from ..core.logs import info, warn
from ..core.option_types import check_types

MOST_KEPT = 256
"""Number of parsed configurations that are kept."""
EXPECTED = {"Integer": "a whole number", "Float": "a number", "bool": "true or false"}
"""By the names that OmegaConf has for types."""
_parsed: dict[tuple[Any, str], DictConfig] = {}
"""By class and text of the values."""


def parse_structured(config_class: Any, values: Any = None) -> DictConfig:
    """Fill the dataclass ``config_class`` with ``values`` and check their types; ranges are
    checked by ``core/options.py``.

    The options of a part are parsed when they are checked and again when it is built, and OmegaConf
    takes several times as long to build a configuration as to copy one; so results are kept.

    Raises:
        UserError: an unknown key, a value of the wrong type or a missing one; the message begins
            with the key.
    """
    key = (config_class, repr(values))
    if "${" in key[1]:  # may refer to values elsewhere
        return _parse(config_class, values)
    if key not in _parsed:
        if len(_parsed) == MOST_KEPT:
            _parsed.clear()
        _parsed[key] = _parse(config_class, values)
    return copy.deepcopy(_parsed[key])


def _parse(config_class: Any, values: Any) -> DictConfig:
    """Parse once. Interpolations have been resolved before, so a remaining ``${`` in a string is
    escaped: OmegaConf must not resolve it.
    """
    if values is not None and not isinstance(values, Mapping):
        raise UserError(f"expected keys and values, got {values!r}")
    values = without_removed(config_class, values or {})
    known = [field.name for field in fields(config_class)]
    for key in values:
        if key not in known:
            raise unknown("key", key, known)
    try:
        check_types(config_class, values)
        return OmegaConf.structured(
            config_class(**{key: escape(value) for key, value in values.items()})
        )
    except OmegaConfBaseException as error:
        raise UserError(f"{error.full_key or error.key}: {_problem(error)}") from error
    except TypeError as error:
        raise UserError(f"{config_class.__qualname__}: {error}") from error


def without_removed(config_class: Any, values: Any, path: str = "") -> Any:
    """Return a section without the options that its part had in earlier versions.

    ``Config.REMOVED`` has their names, each with the value that did nothing, or a function that
    says whether a value did, and with what is the case now. Each that is given is named in a line,
    a warning if it did something.

    Args:
        path: of the section, for messages, such as "system.guidance.".
    """
    removed = getattr(config_class, "REMOVED", {})
    known = {field.name for field in fields(config_class)}  # a derived part may have its own
    found = [key for key in values if key in removed and key not in known]
    for key in found:
        neutral, now = removed[key]
        did_nothing = neutral(values[key]) if callable(neutral) else values[key] == neutral
        tell = info if did_nothing else warn
        tell(f"{path}{key} is no option any more: {now}")
    kept = {key: values[key] for key in values if key not in found}
    for section in fields(config_class):
        if is_dataclass(section.type) and isinstance(kept.get(section.name), Mapping):
            nested = f"{path}{section.name}."
            kept[section.name] = without_removed(section.type, kept[section.name], nested)
    return kept


def _problem(error: OmegaConfBaseException) -> str:
    """Return what is wrong with a value, in the words of the other checks of options."""
    message = str(error).splitlines()[0]
    found = re.fullmatch(
        r"Value (.*) (?:of type .* could not be converted to|is not a valid) (\w+).*", message
    )
    if found is None or found[2] not in EXPECTED:
        return message
    return f"expected {EXPECTED[found[2]]}, got {found[1]}"
