"""Check a whole configuration before any work: keys at every depth, types and registered names.

The key ``x_type`` names the part that the section ``x`` beside it configures: ``data_type`` and
``data``, ``system.geometry_type`` and ``system.geometry``, ``system.geometry.prior_type`` and
``system.geometry.prior``. The keys of a section are the fields of its part's ``Config``."""

import inspect
import os
import types
import typing
from typing import Any

import torch
from omegaconf import OmegaConf

from ..core.distributed import require_shareable
from ..core.errors import UserError, unknown
from ..core.methods import require_dataclass
from ..core.options import (
    drop_removed,
    parse_structured,
    require_mapping,
    require_representable,
    shown,
)
from ..host import find, pl, validate_schedule
from ..training.data import sizes_of_stages
from .live_viewer import ViewerConfig
from .part_kinds import check_kind, find_part

MisconfigurationException = pl.utilities.exceptions.MisconfigurationException

LAUNCHER_SETS = {
    "accelerator": "--gpu",
    "callbacks": "the launcher",
    "logger": "the launcher and system.loggers",
    "plugins": "the launcher",
    "inference_mode": "the launcher",
    "enable_checkpointing": "the launcher",
    "default_root_dir": "exp_root_dir",
    "dirpath": "exp_root_dir, name and tag",
}
# left out when the trainer is built for the check, since they start or look for other processes
NEEDS_PROCESSES = ("strategy", "num_nodes", "sync_batchnorm")
# refused: they start processes that don't import custom parts, and then wait forever
SPAWNING = ("ddp_spawn", "ddp_fork", "ddp_notebook")
# smallest valid values, which Lightning itself doesn't check before training
AT_LEAST = {
    "log_every_n_steps": 0,
    "num_sanity_val_steps": -1,
    "max_steps": -1,
    "min_steps": 0,
    "check_val_every_n_epoch": 1,
    "accumulate_grad_batches": 1,
}
# the only values that work where views are drawn without end, as repr shows them: Lightning takes
# 1.0 for all batches and 1 for one; None: the key isn't given
DEFAULTS_ONLY = {"limit_train_batches": ("None", "1.0"), "overfit_batches": ("None", "0", "0.0")}
CLUSTER = {"MASTER_ADDR", "SLURM_NTASKS"}
LONGEST_NAME = 200
"""Longest name of a checkpoint, bytes; file systems allow 255, of which numbers and suffixes need
some.
"""
LOGGER_KEYS = ("enable", "project", "name")


def check_config(cfg: Any) -> None:
    """Check the result of :func:`config.load_config` against the registered parts and Lightning's
    signatures.

    Raises:
        UserError: an unknown key or name (with the nearest valid one), or a value of the wrong type
            or out of range. The message is about the first error and begins with its dotted path.
    """
    for section in cfg:
        require_representable(section, cfg[section])
    if not 0 <= cfg.seed < 2**32:
        raise UserError(f"seed is {cfg.seed}; expected a whole number from 0 to 2^32 - 1")
    # the trainer first, since schedules of parts may refer to its number of steps
    _check_arguments("trainer", cfg.trainer, pl.Trainer)
    _check_trainer_ranges(cfg.trainer)
    _check_strategy(cfg.trainer.get("strategy"))
    parse_structured(ViewerConfig, cfg.viewer, "viewer.")
    check_part("data", cfg.data_type, cfg.data)
    check_part("system", cfg.system_type, cfg.system)
    _check_loss(cfg.system.get("loss"), getattr(find(cfg.system_type), "LOSSES", None))
    check_sections(cfg)
    _check_loggers(cfg.system.get("loggers"))
    _check_arguments("checkpoint", cfg.checkpoint, pl.callbacks.ModelCheckpoint)
    if cfg.checkpoint.get("every_n_train_steps") == cfg.trainer.get("max_steps") == -1:
        raise UserError(
            "checkpoint.every_n_train_steps is -1, as trainer.max_steps, from which configurations "
            "take it: for a run without an end, set it to a number of steps"
        )
    _check_monitor(cfg)
    _check_file_name(build("checkpoint", pl.callbacks.ModelCheckpoint, plain(cfg.checkpoint)))
    options = {
        key: value for key, value in plain(cfg.trainer).items() if key not in NEEDS_PROCESSES
    }
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
        if not typed[key] and (default := getattr(config_class, key, None)):
            raise UserError(f"{path}.{key} is empty: name a registered part, such as {default!r}")
        if typed[key]:
            given = values.get(section)
            check_part(f"{path}.{section}", typed[key], typed[section] if given is None else given)


def _check_loss(loss: Any, known: Any) -> None:
    for key, weight in (loss or {}).items():
        if not key.startswith("lambda_"):
            raise UserError(
                f"unknown key 'system.loss.{key}': weights of losses are called lambda_<loss>, "
                "such as lambda_sds"
            )
        if known is not None:
            weights = [name if name.startswith("lambda_") else f"lambda_{name}" for name in known]
            if key not in weights and weight != 0:
                raise unknown("key", key, weights, prefix="system.loss.")
        validate_schedule(weight, f"system.loss.{key}")


def _check_loggers(loggers: Any) -> None:
    for name, options in (loggers or {}).items():
        if name != "wandb":
            raise unknown("key", name, ["wandb"], prefix="system.loggers.")
        require_mapping(f"system.loggers.{name}", options)
        for key in options:
            if key not in LOGGER_KEYS:
                raise unknown("key", key, LOGGER_KEYS, prefix="system.loggers.wandb.")


def _check_arguments(section: str, values: Any, owner: type) -> None:
    parameters = dict(inspect.signature(owner.__init__).parameters)
    parameters.pop("self")
    require_mapping(section, values)
    for key, value in values.items():
        if key in LAUNCHER_SETS:
            raise UserError(f"{section}.{key} is set by {LAUNCHER_SETS[key]}: remove it")
        if key not in parameters:
            allowed = [name for name in parameters if name not in LAUNCHER_SETS]
            raise unknown("key", key, allowed, prefix=f"{section}.")
        _check_type(f"{section}.{key}", value, parameters[key].annotation)


def _check_type(path: str, value: Any, annotation: Any) -> None:
    """Raise UserError unless ``value`` has one of the plain types that ``annotation`` allows.

    If the annotation also allows objects or literals, nothing is checked here: :func:`build` does.
    """
    accepted = _plain_types(annotation)
    if not accepted or (
        isinstance(value, int) and not isinstance(value, bool) and float in accepted
    ):
        return
    if type(value) not in accepted:
        known = ", ".join(
            sorted("null" if kind is type(None) else kind.__name__ for kind in accepted)
        )
        raise UserError(f"{path} is {value!r} ({type(value).__name__}); expected one of: {known}")


def _plain_types(annotation: Any) -> set[type]:
    """Return the types of an annotation such as ``Optional[Union[int, float]]``; an empty set if it
    has other types than int, float, bool, str and None.
    """
    if typing.get_origin(annotation) in (typing.Union, types.UnionType):
        inner = [_plain_types(argument) for argument in typing.get_args(annotation)]
        return set().union(*inner) if all(inner) else set()
    return {annotation} if annotation in (int, float, bool, str, type(None)) else set()


def _check_trainer_ranges(trainer: Any) -> None:
    for key, lowest in AT_LEAST.items():
        if (trainer.get(key) if trainer.get(key) is not None else lowest) < lowest:
            raise UserError(f"trainer.{key}: expected {lowest} or more, got {trainer[key]}")
    for key, defaults in DEFAULTS_ONLY.items():
        if repr(trainer.get(key)) not in defaults:
            raise UserError(
                f"trainer.{key}: views are drawn without end, so this has no use; set "
                f"trainer.max_steps for a short run, got {trainer[key]}"
            )
    if isinstance(trainer.get("max_time"), (int, float)):
        raise UserError(
            "trainer.max_time: expected a text such as '00:12:00:00' (days, hours, minutes, "
            f"seconds), got {trainer.max_time}"
        )
    if trainer.get("num_nodes", 1) != 1 and not CLUSTER & os.environ.keys():
        raise UserError(
            f"trainer.num_nodes: expected 1, got {trainer.num_nodes}; several machines need a "
            f"launcher that sets {' or '.join(sorted(CLUSTER))}"
        )
    interval = trainer.get("val_check_interval")
    if interval == 0 or (isinstance(interval, float) and interval != 1):
        raise UserError(
            "trainer.val_check_interval: expected a whole number of steps above 0, got "
            f"{interval} (for no validation: trainer.limit_val_batches=0)"
        )
    if trainer.get("limit_test_batches") in (0, 0.0):
        raise UserError(
            "trainer.limit_test_batches: expected more than 0, since results are exported after "
            "the test views (for one view: data.n_test_views=1)"
        )


def _check_strategy(name: Any) -> None:
    """Check that Lightning has the strategy, and that what it needs is installed.

    Raises:
        UserError: it is unknown, can't be used here, or can't be constructed.
    """
    registry = pl.strategies.StrategyRegistry
    known = registry.available_strategies()
    name = "auto" if name is None else str(name).lower()
    if name == "auto":
        return
    if name not in known:
        raise unknown("trainer.strategy", name, ["auto", *known])
    if name.startswith(SPAWNING):
        raise UserError(
            f"trainer.strategy: {name} can't start processes of this program; give --gpu 0,1,... "
            "alone, or ddp"
        )
    build("trainer.strategy", registry.get, {"name": name})


def _check_file_name(checkpointing: Any) -> None:
    """Raise UserError unless Lightning can make names of files from ``checkpoint.filename``."""
    name = checkpointing.filename
    if name is None:
        return
    start = {"epoch": torch.tensor(0), "step": torch.tensor(0)}
    try:
        made = checkpointing.format_checkpoint_name(start)
    except Exception as error:  # of str.format, for instance ValueError, KeyError, AttributeError
        raise UserError(
            f"checkpoint.filename is {name!r}, which isn't a format: {error}"
        ) from error
    if os.path.isabs(made) or os.path.normpath(made).startswith(os.pardir):
        raise UserError(
            f"checkpoint.filename is {name!r}; expected a name below the folder of the checkpoints"
        )
    longest = max(len(os.fsencode(part)) for part in made.split(os.sep))
    if "\0" in made or longest > LONGEST_NAME:
        raise UserError(
            f"checkpoint.filename is {shown(name)}; expected names of at most {LONGEST_NAME} bytes "
            "without NUL"
        )


def _check_monitor(cfg: Any) -> None:
    """Check that ``checkpoint.monitor`` is logged; Lightning fails only after the first validation.

    Systems may have a static method ``logged`` that returns the logged names for a configuration;
    without it nothing is checked."""
    monitor, system = cfg.checkpoint.get("monitor"), find(cfg.system_type)
    logged = getattr(system, "logged", None)
    if monitor is None or logged is None:
        return
    quantities = logged(parse_structured(system.Config, cfg.system, "system."))
    if quantities is not None and monitor not in quantities | {"epoch", "step"}:
        raise unknown("checkpoint.monitor", monitor, quantities)
    if not cfg.trainer.get("log_every_n_steps", 1):
        raise UserError(
            f"checkpoint.monitor is {monitor!r}, but with trainer.log_every_n_steps=0 nothing "
            "is logged"
        )


def build(section: str, owner: type, arguments: dict) -> Any:
    """Construct ``owner(**arguments)``, in which Lightning checks combinations and literals.

    Raises:
        UserError: the constructor fails.
    """
    try:
        return owner(**arguments)
    except Exception as error:  # Lightning also raises OverflowError, AttributeError, ImportError
        raise UserError(f"{section}: {str(error) or type(error).__name__}") from error


def plain(section: Any) -> dict:
    """Convert a section to plain Python values."""
    return typing.cast(dict, OmegaConf.to_container(section, resolve=True))


# -- options that contradict each other in different sections --------------------------------------

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
