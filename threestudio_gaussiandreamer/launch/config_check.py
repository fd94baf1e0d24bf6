"""Check a whole configuration before any work: keys at every depth, types and registered names.

The key ``x_type`` names the part that the section ``x`` beside it configures; the keys of a section
are the fields of its part's ``Config``."""

import inspect
import os
from collections.abc import Mapping
from dataclasses import field, make_dataclass
from pathlib import Path
from typing import Any

import torch
from omegaconf import OmegaConf

from ..core.errors import UserError, unknown
from ..core.options import (
    Rule,
    at_least,
    drop_removed,
    one_of,
    parse_structured,
    require_mapping,
    satisfies,
)
from ..host import find, pl
from ..host.methods import require_dataclass
from ..training.data import require_shareable, sizes_of_stages
from .live_viewer import ViewerConfig
from .parts import check_kind, find_part

LAUNCHER_SETS = {
    **dict.fromkeys(("callbacks", "logger", "plugins", "inference_mode"), "the launcher"),
    **{"enable_checkpointing": "the launcher", "accelerator": "--gpu"},
    **{"default_root_dir": "exp_root_dir", "dirpath": "exp_root_dir, name and tag"},
}
# left out when the trainer is built for the check, since they start or look for other processes
NEEDS_PROCESSES = ("strategy", "num_nodes", "sync_batchnorm")
CLUSTER = ("MASTER_ADDR", "SLURM_NTASKS")
ENDLESS = "no value, since views are drawn without end; set trainer.max_steps for a short run"
TRAINER: dict[str, Rule] = {
    "log_every_n_steps": at_least(0),
    "num_sanity_val_steps": at_least(-1),
    "max_steps": at_least(-1),
    "min_steps": at_least(0),
    "check_val_every_n_epoch": at_least(1),
    "accumulate_grad_batches": at_least(1),
    # Lightning takes 1.0 for all batches and 1 for one
    "limit_train_batches": satisfies(ENDLESS, lambda share: repr(share) == "1.0"),
    "overfit_batches": satisfies(ENDLESS, lambda share: share == 0),
    "limit_test_batches": satisfies(
        "more than 0, since results are exported after the test views (for one view: "
        "data.n_test_views=1)",
        lambda share: share != 0,
    ),
    "val_check_interval": satisfies(
        "a whole number of steps above 0 (for no validation: trainer.limit_val_batches=0)",
        lambda steps: steps != 0 and not (isinstance(steps, float) and steps != 1),
    ),
    "max_time": satisfies(
        "a text such as '00:12:00:00' (days, hours, minutes, seconds)",
        lambda time: not isinstance(time, (int, float)),
    ),
    "num_nodes": satisfies(
        f"1 without a launcher of several machines, which sets {' or '.join(CLUSTER)}",
        lambda count: count == 1 or any(name in os.environ for name in CLUSTER),
    ),
    "strategy": one_of(("auto", "ddp")),
}
"""What Lightning itself doesn't check before training, or what has no use here."""
DATA = ("gaussiandreamer-datamodule", "random-camera-datamodule")
"""Data modules that draw new views in each step."""


def check_config(cfg: Any) -> None:
    """Check the result of :func:`config.load_config` against the registered parts and Lightning's
    signatures; raise UserError for an unknown key or name (with the nearest valid one), or a value
    of the wrong type or out of range.
    """
    if cfg.trainer.get("strategy", "auto") is None:  # as an earlier parsed.yaml may have it
        cfg.trainer.strategy = "auto"
    # the trainer first, since schedules of parts may refer to its number of steps
    _check_arguments("trainer", cfg.trainer, pl.Trainer, TRAINER)
    drop_removed(ViewerConfig, cfg.viewer, "viewer.")
    parse_structured(ViewerConfig, cfg.viewer, "viewer.")
    check_part("data", cfg.data_type, cfg.data)
    check_part("system", cfg.system_type, cfg.system)
    check_sections(cfg)
    _check_arguments("checkpoint", cfg.checkpoint, pl.callbacks.ModelCheckpoint, {})
    # Lightning looks for what is to be monitored only after the first validation
    monitor, system = cfg.checkpoint.get("monitor"), find(cfg.system_type)
    if monitor is not None and hasattr(system, "logged"):
        logged = system.logged(parse_structured(system.Config, cfg.system, "system."))
        if logged is not None and monitor not in logged | {"epoch", "step"}:
            raise unknown("checkpoint.monitor", monitor, logged)
        if monitor not in ("epoch", "step") and not cfg.trainer.get("log_every_n_steps", 1):
            raise UserError("checkpoint.monitor: trainer.log_every_n_steps=0 logs nothing")
    checkpointing = build("checkpoint", pl.callbacks.ModelCheckpoint, plain(cfg.checkpoint))
    numbers = dict.fromkeys(("epoch", "step"), torch.tensor(0))  # files are named in the end
    made = build("checkpoint.filename", checkpointing.format_checkpoint_name, {"metrics": numbers})
    parts = Path(made).parts
    longest = max(len(os.fsencode(part)) for part in parts)
    if os.path.isabs(made) or ".." in parts or "\0" in made or longest > 200:
        raise UserError("checkpoint.filename: expected a name of at most 200 bytes below ckpts/")
    options = {key: v for key, v in plain(cfg.trainer).items() if key not in NEEDS_PROCESSES}
    build("trainer", pl.Trainer, {**options, "devices": 1, "logger": False})


def check_part(path: str, type_name: Any, values: Any) -> None:
    """Check one section against the part ``type_name``, and the sections of its own parts."""
    part = find_part(f"{path}_type", type_name)
    check_kind(f"{path}_type", type_name, part)
    config_class = getattr(part, "Config", None)
    if config_class is None:
        return
    try:
        require_dataclass(part)
    except UserError as error:
        raise UserError(f"{path}_type: {error}") from error
    require_mapping(path, values)
    drop_removed(config_class, values, f"{path}.")
    for key in values:  # before the part's own checks, whose messages don't name the key
        if key.endswith("_type") and key.removesuffix("_type") in values and values.get(key):
            find_part(f"{path}.{key}", values[key])
    typed = vars(parse_structured(config_class, values, f"{path}."))
    for key in typed:
        section = key.removesuffix("_type")
        if section == key or section not in typed:
            continue
        if typed[key] or getattr(config_class, key, None):  # an empty name is an error there
            given = values.get(section)
            check_part(f"{path}.{section}", typed[key], typed[section] if given is None else given)


def _check_arguments(section: str, values: Any, owner: type, rules: Mapping[str, Rule]) -> None:
    """Check a section against the arguments of a class of Lightning; texts become numbers."""
    require_mapping(section, values)
    for key in values:
        if key in LAUNCHER_SETS:
            raise UserError(f"{section}.{key} is set by {LAUNCHER_SETS[key]}: remove it")
    arguments = [
        (name, given.annotation, field(default=given.default, metadata=rules.get(name, {})))
        for name, given in inspect.signature(owner).parameters.items()
        if name not in LAUNCHER_SETS
    ]
    typed = parse_structured(make_dataclass(owner.__name__, arguments), values, f"{section}.")
    for key in values:
        if type(getattr(typed, key)) in (bool, int, float):
            values[key] = getattr(typed, key)


def build(section: str, owner: type, arguments: dict) -> Any:
    """Return ``owner(**arguments)``; raise UserError for combinations that Lightning refuses."""
    try:
        return owner(**arguments)
    except Exception as error:  # Lightning also raises OverflowError, AttributeError, ImportError
        raise UserError(f"{section}: {str(error) or type(error).__name__}") from error


def plain(section: Any) -> Any:
    """Convert a section to plain Python values."""
    return OmegaConf.to_container(section, resolve=True)


# -- options that contradict each other in different sections --------------------------------------


def check_sections(cfg: Any) -> None:
    """Raise UserError if the guidance contradicts the cameras, the renderer or the prompts."""
    name, system = cfg.system.get("guidance_type"), cfg.system
    options = getattr(find(name), "Config", None) if name else None
    if options is None:
        return
    guidance = parse_structured(options, system.get("guidance"))
    # a model that sees several views together must get them together
    together, given = getattr(guidance, "n_view", 1), cfg.data.get("n_view", 1)
    if together not in (1, given):
        raise UserError(
            f"data.n_view: the guidance sees {together} views of an object together, got {given}: "
            f"set data.n_view={together} and data.batch_size to a multiple of it"
        )
    if hasattr(options, "check_render_size") and cfg.data_type in DATA:
        data = parse_structured(find(cfg.data_type).Config, cfg.data)
        downsample = (system.get("renderer") or {}).get("downsample", 1)
        for height, width, _ in sizes_of_stages(data):
            options.check_render_size(guidance, height // downsample, width // downsample)
    by_text = hasattr(guidance, "view_dependent_prompting")
    if by_text and system.get("prompt_processor_type") == "plain-prompt-processor":
        raise UserError(f"system.prompt_processor_type: {name} needs one that encodes text")
    if by_text and (system.get("prompt_processor") or {}).get("use_perp_neg"):
        reasons = {
            "and this guidance has one prompt for all: set it to false": together > 1,
            "of which there is one: set system.guidance.view_dependent_prompting=true": (
                not guidance.view_dependent_prompting
            ),
            "as view_contrast does: set it to false, or system.guidance.view_contrast=0": (
                getattr(guidance, "view_contrast", 0)
            ),
        }
        if reason := next((reason for reason, holds in reasons.items() if holds), None):
            raise UserError(
                "system.prompt_processor.use_perp_neg: Perp-Neg compares the prompts of views, "
                f"{reason}"
            )


def check_shared_views(cfg: Any) -> None:
    """Raise UserError if the processes that are to train can't share the views of a step."""
    if cfg.data_type in DATA:
        data = parse_structured(find(cfg.data_type).Config, cfg.data)
        require_shareable(data, cfg.n_gpus)
