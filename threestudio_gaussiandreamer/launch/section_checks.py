"""Checks of options that contradict each other in different sections of a configuration, where each
section is valid by itself.
"""

from typing import Any

from ..core.distributed import require_shareable
from ..core.errors import UserError
from ..host import find, parse_structured
from ..training.camera_options import sizes_of_stages

DATA = ("gaussiandreamer-datamodule", "random-camera-datamodule")
"""Data modules that draw new views in each step."""


def check_sections(cfg: Any) -> None:
    """Check the guidance's options against those of the cameras, background and prompts.

    Args:
        cfg: a configuration whose sections have been checked.

    Raises:
        UserError: they contradict each other.
    """
    name = cfg.system.get("guidance_type")
    options = getattr(find(name), "Config", None) if name else None
    if options is None:
        return
    guidance = parse_structured(options, cfg.system.get("guidance"))
    _check_view_groups(guidance, cfg.data)
    if hasattr(options, "check_render_size") and cfg.data_type in DATA:
        _check_render_sizes(options, guidance, cfg)
    if hasattr(guidance, "view_dependent_prompting"):
        _check_prompts(guidance, cfg.system)


def check_shared_views(cfg: Any) -> None:
    """Raise UserError if the processes that are to train can't share the views of a step."""
    if cfg.data_type not in DATA:
        return
    data = parse_structured(find(cfg.data_type).Config, cfg.data)
    for *_, views in sizes_of_stages(data):
        require_shareable(
            views, "data.batch_size", together=getattr(data, "n_view", 1), processes=cfg.n_gpus
        )


def _check_view_groups(guidance: Any, data: Any) -> None:
    """Raise UserError unless a model that sees several views together gets them together."""
    together, given = getattr(guidance, "n_view", 1), data.get("n_view", 1)
    if together not in (1, given):
        raise UserError(
            f"data.n_view: the guidance sees {together} views of an object together, got {given}: "
            f"set data.n_view={together} and data.batch_size to a multiple of it"
        )


def _check_render_sizes(options: type, guidance: Any, cfg: Any) -> None:
    """Raise UserError where the guidance can't compare the renders of a training stage."""
    data = parse_structured(find(cfg.data_type).Config, cfg.data)
    downsample = (cfg.system.get("renderer") or {}).get("downsample", 1)
    for height, width, _ in sizes_of_stages(data):
        options.check_render_size(guidance, height // downsample, width // downsample)


def _check_prompts(guidance: Any, system: Any) -> None:
    """Raise UserError where a guidance by text can't use the prompts."""
    if system.get("prompt_processor_type") == "plain-prompt-processor":
        raise UserError(
            f"system.prompt_processor_type: {system.guidance_type} needs a prompt processor that "
            "encodes text, plain-prompt-processor doesn't"
        )
    if not (system.get("prompt_processor") or {}).get("use_perp_neg"):
        return
    refused = "system.prompt_processor.use_perp_neg: Perp-Neg compares the prompts of views"
    if getattr(guidance, "n_view", 1) > 1:
        raise UserError(f"{refused}, and this guidance has one prompt for all: set it to false")
    if not guidance.view_dependent_prompting:
        raise UserError(f"{refused}: set system.guidance.view_dependent_prompting=true")
    if getattr(guidance, "view_contrast", 0):
        raise UserError(
            "view_contrast and Perp-Neg both compare the prompts of views: set "
            "system.prompt_processor.use_perp_neg=false, or system.guidance.view_contrast=0"
        )
