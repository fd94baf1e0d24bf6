"""Check what the parts of a run need from outside, before any long work."""

from typing import Any

from ..core.methods import require_class_method
from ..host import find, parse_structured
from ..priors.base import preflight_prior


def preflight_parts(geometry: Any, cfg: Any) -> None:
    """Call ``preflight`` of the prior, if the cloud is empty, and of the classes of prompt
    processor and guidance with their options.

    Args:
        cfg: the system's options.

    Raises:
        UserError: something that a part needs, such as a file, is missing.
    """
    if not len(geometry):
        preflight_prior(geometry.prior(), geometry.cfg.keep_attributes)
    for name in ("prompt_processor", "guidance"):
        part = find(cfg[f"{name}_type"])
        if hasattr(part, "preflight"):
            require_class_method(part, "preflight")
            part.preflight(parse_structured(part.Config, cfg[name]))
