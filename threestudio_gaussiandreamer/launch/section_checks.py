"""Checks of options that contradict each other in different sections of a configuration, where each
section is valid by itself.
"""

from typing import Any

from ..core.distributed import require_shareable
from ..core.errors import UserError
from ..guidance.view_contrast import NOT_WITH_PERP_NEG
from ..host import find, parse_structured
from ..training.camera_options import sizes_of_stages

DATA = ("gaussiandreamer-datamodule", "random-camera-datamodule")
"""Data modules that draw new views in each step, unless ``hold_steps`` is more than 1."""


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
    _check_reuse(guidance, cfg)
    if hasattr(options, "check_render_size") and cfg.data_type in DATA:
        _check_render_sizes(options, guidance, cfg)
    if "view_dependent_prompting" in guidance:
        _check_prompts(guidance, cfg.system)


def check_shared_views(cfg: Any) -> None:
    """Raise UserError if the processes that are to train can't share the views of a step."""
    if cfg.data_type not in DATA:
        return
    data = parse_structured(find(cfg.data_type).Config, cfg.data)
    for *_, views in sizes_of_stages(data):
        require_shareable(
            views, "data.batch_size", together=data.get("n_view", 1), processes=cfg.n_gpus
        )


def _check_view_groups(guidance: Any, data: Any) -> None:
    """Raise UserError unless a model that sees several views together gets them together."""
    together, given = guidance.get("n_view", 1), data.get("n_view", 1)
    if together not in (1, given):
        raise UserError(
            f"data.n_view: the guidance sees {together} views of an object together, got {given}: "
            f"set data.n_view={together} and data.batch_size to a multiple of it"
        )


def _check_reuse(guidance: Any, cfg: Any) -> None:
    """Raise UserError where a prediction couldn't serve as many steps as ``reuse_steps`` says."""
    steps = guidance.get("reuse_steps", 1)
    if steps == 1:
        return
    wanted = f"system.guidance.reuse_steps={steps} needs steps of the same"
    if cfg.data_type in DATA:
        data = parse_structured(find(cfg.data_type).Config, cfg.data)
        if data.get("hold_steps", 1) % steps and not _has_one_batch(data):
            raise UserError(f"{wanted} views: set data.hold_steps={steps}, or to a multiple of it")
    background = cfg.system.get("background") or {}
    if background.get("mode") == "learned":
        raise UserError(f"{wanted} background, and a learned one changes in each step")
    if background.get("mode") == "random" and background.get("hold_steps", 1) % steps:
        raise UserError(
            f"{wanted} background: set system.background.hold_steps={steps}, or to a multiple of it"
        )


def _has_one_batch(data: Any) -> bool:
    """Return whether all steps draw the same views of a pool: one, or one of each sector."""
    pool = data.get("train_views", 0)
    batches = [views for *_, views in sizes_of_stages(data)]
    return pool == 1 or data.batch_uniform_azimuth and all(views == pool for views in batches)


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
    if guidance.get("n_view", 1) > 1:
        raise UserError(f"{refused}, and this guidance has one prompt for all: set it to false")
    if not guidance.view_dependent_prompting:
        raise UserError(f"{refused}: set system.guidance.view_dependent_prompting=true")
    if guidance.get("view_contrast"):
        raise UserError(NOT_WITH_PERP_NEG)
