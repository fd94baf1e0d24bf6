"""Check what the parts of a run need from outside, before any long work."""

import contextlib
from collections.abc import Iterator
from typing import Any

from ..core.errors import UserError
from ..core.methods import require_class_method
from ..host import find, parse_structured
from ..priors.base import preflight_prior

OURS = {"geometry": "gaussiandreamer-cloud", "renderer": "gaussiandreamer-splatting"}
"""Parts whose methods, options or outputs the system uses beyond those of the host's."""


def check_parts(cfg: Any) -> None:
    """Check which parts the system's options name.

    Raises:
        UserError: a part is missing, or isn't derived from the class that the system needs.
    """
    for name in ("geometry", "renderer", "guidance", "prompt_processor"):
        key = f"{name}_type"
        if not getattr(cfg, key):
            raise UserError(f"{key} is empty: name a registered part")
    for name, ours in OURS.items():
        key, base = f"{name}_type", find(ours)
        if not issubclass(find(part := getattr(cfg, key)), base):
            raise UserError(
                f"{key} is {part!r}: gaussiandreamer-system needs {ours}, or a class that is "
                f"derived from {base.__module__}.{base.__name__}"
            )


def preflight_parts(geometry: Any, cfg: Any) -> None:
    """Call ``preflight`` of the prior, if the cloud is empty, and of the classes of prompt
    processor and guidance with their options.

    Args:
        cfg: the system's options.

    Raises:
        UserError: something that a part needs, such as a file, is missing; the message names the
            part's section.
    """
    if not len(geometry):
        with _named("system.geometry.prior"):
            preflight_prior(geometry.prior(), geometry.cfg.keep_attributes)
    for name in ("prompt_processor", "guidance"):
        part = find(getattr(cfg, f"{name}_type"))
        if hasattr(part, "preflight"):
            require_class_method(part, "preflight")
            with _named(f"system.{name}"):
                part.preflight(parse_structured(part.Config, getattr(cfg, name)))


@contextlib.contextmanager
def _named(section: str) -> Iterator[None]:
    """Put a section of the configuration in front of errors that don't name it."""
    try:
        yield
    except UserError as error:
        if section in str(error):
            raise
        raise UserError(f"{section}: {error}") from error
