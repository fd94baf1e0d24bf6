"""The configuration of a run: YAML files, then ``key=value`` overrides, merged, resolved and typed.

Sections, key names, resolvers and the output tree are threestudio's. Two things differ: loading
makes no folder, and what is text stays text (see ``config_source.py``). The sources are read by
``config_source.py``; the folder is named by ``run_folder.py``."""

import functools
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, fields
from itertools import combinations
from pathlib import Path
from typing import Any, Optional

import omegaconf
from omegaconf import MISSING, DictConfig, ListConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from ..core.errors import UserError
from ..core.files import atomic_file
from ..core.interpolation import escape
from ..core.options import parse_structured
from ..core.schedule import C_max
from ..host import find, info, names
from ..prompts.prompts import read_prompt
from ..training.losses import foreign_weights
from ..training.optimizer import foreign_arguments
from .config_source import is_text, map_strings, parse_overrides, protect, read_yaml, unprotect
from .ddp import planned_processes
from .run_folder import name_folders


@dataclass
class ExperimentConfig:
    """The keys at the top level of a YAML file. Those from ``exp_dir`` to ``n_gpus`` are computed;
    they are accepted because a ``parsed.yaml`` has them.
    """

    name: str = "default"
    description: str = ""
    tag: str = ""
    seed: int = 0
    use_timestamp: bool = True
    timestamp: Optional[str] = None
    exp_root_dir: str = "outputs"
    resume: Optional[str] = None

    exp_dir: str = ""
    trial_name: str = ""
    trial_dir: str = ""
    new_folder: bool = False
    n_gpus: int = 1

    data_type: str = ""
    data: dict = field(default_factory=dict)
    system_type: str = ""
    system: dict = field(default_factory=dict)
    # arguments of Lightning's Trainer and ModelCheckpoint
    trainer: dict = field(default_factory=dict)
    checkpoint: dict = field(default_factory=dict)
    viewer: dict = field(default_factory=dict)
    """See ``live_viewer.py``."""


COMPUTED = ("exp_dir", "trial_name", "trial_dir", "new_folder", "n_gpus")
"""Keys that only a ``parsed.yaml`` may have."""


def load_config(*paths: str | os.PathLike, cli_args: Sequence[str] = (), n_gpus: int = 0) -> Any:
    """Merge YAML files, of which later ones take precedence, and ``key=value`` overrides into the
    configuration of a run. No folder is created.

    Args:
        n_gpus: visible GPUs; 0 for the CPU.

    Returns:
        an :class:`ExperimentConfig` as a DictConfig without interpolations.

    Raises:
        UserError: a file can't be read, an override isn't ``key=value``, a top-level key is
            unknown, a ``???`` or an interpolation is left open, a value has the wrong type; see
            also :func:`planned_processes`.
    """
    sources = [
        _with_prompt_from_file(source)
        for source in [*map(read_yaml, paths), parse_overrides(cli_args)]
    ]
    if given := [name for name in COMPUTED if name in sources[-1]]:
        raise UserError(
            f"{given[0]} is computed: set exp_root_dir, name and tag for the folder of a run, and "
            "--gpu or trainer.devices for the GPUs"
        )
    merged = _merge(sources)
    _name_own_object(merged, sources)
    trainer = {name: _trainer_option(merged, name) for name in ("devices", "num_nodes")}
    merged.n_gpus = planned_processes(n_gpus, trainer).total
    _require_mandatory(OmegaConf.to_container(merged))
    resolved = _resolve(merged)
    _zero_null_weights(resolved.get("system"))
    cfg = OmegaConf.structured(parse_structured(ExperimentConfig, escape(resolved)))
    name_folders(cfg, paths)
    return cfg


def _trainer_option(merged: DictConfig, name: str) -> Any:
    """Return an option before all are resolved; None if it can't be, which is reported later."""
    try:
        return OmegaConf.select(merged, f"trainer.{name}")
    except OmegaConfBaseException:
        return None


def dump_config(path: str | os.PathLike, cfg: Any) -> None:
    """Write a configuration from which :func:`load_config` restores the same run, without
    ``resume`` and ``new_folder``.
    """
    plain = OmegaConf.create(OmegaConf.to_container(cfg, resolve=False))
    if "resume" in plain:
        plain.resume = None
    plain.pop("new_folder", None)
    if not plain.get("viewer"):
        plain.pop("viewer", None)  # threestudio doesn't know the key
    with atomic_file(path) as file:
        file.write(OmegaConf.to_yaml(plain).encode())


def _with_prompt_from_file(source: dict[str, Any]) -> dict[str, Any]:
    """Replace ``prompt_processor.prompt_file`` by a ``prompt`` with the file's text, so that the
    tag can refer to it.
    """
    section = _value_at(source, "system.prompt_processor")
    if not isinstance(section, dict) or section.get("prompt_file") is None:
        return source
    if "prompt" in section:
        raise UserError("system.prompt_processor has both prompt and prompt_file: give one of them")
    section["prompt"] = protect(read_prompt(section.pop("prompt_file")))
    return source


def _value_at(source: Any, key: str) -> Any:
    """Return the value at a dotted key; None if there is none."""
    for name in key.split("."):
        source = source.get(name) if isinstance(source, dict) else None
    return source


def _name_own_object(merged: DictConfig, sources: list[dict[str, Any]]) -> None:
    """Let a prompt that no model reads be the name of the mesh or cloud that a later file or the
    command line gives, instead of what the earlier file says of its own object.
    """
    system = merged.get("system")
    if not system or system.get("prompt_processor_type") != "plain-prompt-processor":
        return
    place, keys = "system.prompt_processor.prompt", ("guidance.mesh", "geometry.prior.path")
    for source in reversed(sources):
        if _own_text(source, place) is not None:
            return
        if path := next(filter(None, (_own_text(source, f"system.{key}") for key in keys)), None):
            OmegaConf.update(merged, place, protect(Path(path).stem), force_add=True)
            return


def _own_text(source: dict[str, Any], key: str) -> Optional[str]:
    """Return the text at a dotted key; None for a missing value and one that refers to another."""
    value = _value_at(source, key)
    return value if isinstance(value, str) and not _is_open(value) else None


def _is_open(value: Any) -> bool:
    """Return whether a value is missing or refers to another one."""
    return isinstance(value, str) and (value == MISSING or "${" in value)


def _merge(sources: list[dict[str, Any]]) -> DictConfig:
    *files, overrides = sources
    try:
        merged: dict[str, Any] = functools.reduce(_overlaid, files, {})
        _require_values(merged, overrides)
        merged = _overlaid(merged, overrides)
    except (OmegaConfBaseException, TypeError) as error:
        clash = next(filter(None, (_clash(a, b) for a, b in combinations(sources, 2))), None)
        reason = f"{clash} is a list in one and a section in another" if clash else _explain(error)
        raise UserError(f"the configurations can't be merged: {reason}") from error
    for name in ("data", "system", "trainer", "checkpoint", "viewer"):
        if merged.get(name, {}) is None:  # YAML reads "trainer:" without content as null
            merged[name] = {}
        section = merged.get(name, {})
        if not isinstance(section, dict) and not _is_open(section):  # that is reported later
            raise UserError(
                f"{name} must be a section of keys and values, got {section!r}: set a key, such "
                f"as {name}.<key>=<value>"
            )
    return OmegaConf.create(merged)


def _overlaid(earlier: dict[str, Any], later: dict[str, Any]) -> dict[str, Any]:
    _forget_replaced_parts(earlier, later)
    return OmegaConf.to_container(OmegaConf.merge(earlier, later))


def _require_values(merged: dict[str, Any], overrides: dict[str, Any], path: str = "") -> None:
    """Check that no override empties the section of a part or of the launcher, as ``trainer=``."""
    for key, override in overrides.items():
        section = merged.get(key)
        if not isinstance(section, dict) or not section:
            continue
        if isinstance(override, dict):
            _require_values(section, override, f"{path}{key}.")
        elif override is None and (not path or f"{key}_type" in merged):
            raise UserError(
                f"{path}{key} is empty, which would remove its {len(section)} keys: set one of "
                f"them, such as {path}{key}.{next(iter(section))}=<value>"
            )


def _forget_replaced_parts(earlier: dict[str, Any], later: dict[str, Any], path: str = "") -> None:
    """Remove options from ``earlier`` that are invalid after a merge with ``later``, in place.

    If ``later`` changes a part (``x_type``), the options in ``earlier``'s section ``x`` that the
    new part doesn't have are removed, so that ``system.geometry.prior_type=random-prior`` suffices
    to select another prior; so are the arguments that a new optimiser doesn't take. If ``later``
    has a mandatory value (``???``), ``earlier``'s value is removed too, which OmegaConf's merge
    would keep."""
    for key, theirs in later.items():
        if theirs == MISSING:
            earlier.pop(key, None)
            continue
        section = key.removesuffix("_type")
        mine = earlier.get(key)
        if isinstance(mine, dict) and isinstance(theirs, dict):
            _forget_replaced_parts(mine, theirs, f"{path}{key}.")
            continue
        if key not in earlier or mine == theirs:
            continue
        if f"{path}{key}" == "system.optimizer.name":
            _keep_arguments_of(earlier.get("args"), theirs)
        if section != key:
            _keep_options_of(earlier.get(section), theirs, f"{path}{section}")
            if f"{path}{section}" == "system.guidance":
                _keep_weights_of(earlier.get("loss"), theirs)


def _keep_options_of(section: Any, type_name: Any, path: str) -> None:
    config_class = getattr(find(type_name), "Config", None) if type_name in names() else None
    if config_class is None or not isinstance(section, dict):
        return
    known = {field.name for field in fields(config_class)}
    _leave_out([key for key in section if key not in known], section, type_name, path)


def _keep_arguments_of(arguments: Any, optimizer: Any) -> None:
    if isinstance(arguments, dict):
        foreign = foreign_arguments(optimizer, arguments)
        _leave_out(foreign, arguments, optimizer, "system.optimizer.args")


def _keep_weights_of(loss: Any, guidance: Any) -> None:
    """Remove the weights of losses that belong to the replaced guidance."""
    if guidance in names() and isinstance(loss, dict):
        _leave_out(foreign_weights(loss, find(guidance)), loss, guidance, "system.loss")


def _leave_out(foreign: list[str], section: dict[str, Any], type_name: str, path: str) -> None:
    for key in foreign:
        section.pop(key)
    if foreign:
        info(f"{path}: {type_name} has no {', '.join(foreign)}; left out")


def _zero_null_weights(system: Any) -> None:
    """Replace null among the weights of losses by 0, which parts of the system can compute with."""
    loss = system.get("loss") if isinstance(system, dict) else None
    if isinstance(loss, dict):
        loss |= {key: 0 for key, weight in loss.items() if weight is None}


def _clash(a: dict[str, Any], b: dict[str, Any], section: str = "") -> Optional[str]:
    """Return the first key that is a list in one of the two and a section in the other."""
    for key, one in a.items():
        other = b.get(key)
        if {type(one), type(other)} == {dict, list}:
            return f"{section}{key}"
        if isinstance(one, dict) and isinstance(other, dict):
            if found := _clash(one, other, f"{section}{key}."):
                return found
    return None


def _require_mandatory(cfg: dict[str, Any]) -> None:
    missing = sorted(_missing_keys(cfg))
    if missing:
        example = "a corgi" if is_text(missing[0]) else "..."
        raise UserError(
            f"no value for {', '.join(missing)}: set it in the YAML or as {missing[0]}={example!r}"
        )


def _missing_keys(values: dict[str, Any], section: str = "") -> Iterator[str]:
    # not OmegaConf.missing_keys, which resolves interpolations and fails if one refers to "???"
    for key, value in values.items():
        if value == MISSING:
            yield f"{section}{key}"
        elif isinstance(value, dict):
            yield from _missing_keys(value, f"{section}{key}.")


def _resolve(cfg: DictConfig) -> dict[str, Any]:
    register_resolvers()
    try:
        values = OmegaConf.to_container(cfg, resolve=True)
    except OmegaConfBaseException as error:
        raise UserError(f"an interpolation can't be resolved: {_explain(error)}") from error
    except (TypeError, ValueError, ArithmeticError, AttributeError) as error:
        raise UserError(f"a resolver failed: {error}") from error
    except RecursionError as error:
        raise UserError("an interpolation leads to itself") from error
    return map_strings(values, unprotect)


def _explain(error: Exception) -> str:
    message, key = str(error).splitlines()[0], getattr(error, "full_key", None)
    return f"{key}: {message}" if key else message


def register_resolvers() -> None:
    """Register the functions that a YAML file may call as ``${name:...}``. Those that threestudio
    has registered are kept.
    """
    resolvers = {
        "calc_exp_lr_decay_rate": lambda factor, n: factor ** (1.0 / n),
        "add": lambda a, b: a + b,
        "sub": lambda a, b: a - b,
        "mul": lambda a, b: a * b,
        "div": lambda a, b: a / b,
        "idiv": lambda a, b: a // b,
        "basename": os.path.basename,
        "rmspace": lambda text, substitute: str(text).replace(" ", substitute),
        "tuple2": lambda value: ListConfig([float(value), float(value)]),  # 2.3: no list
        "gt0": lambda value: value > 0,
        "cmaxgt0": lambda value: C_max(value) > 0,
        "not": lambda value: not value,
        "cmaxgt0orcmaxgt0": lambda a, b: C_max(a) > 0 or C_max(b) > 0,
    }
    # omegaconf 2.4 gave the new function the name that the one without nesting had before
    is_old = [int(part) for part in omegaconf.__version__.split(".")[:2]] < [2, 4]
    enter = OmegaConf.register_new_resolver if is_old else OmegaConf.register_resolver
    for name, function in resolvers.items():
        if not OmegaConf.has_resolver(name):
            enter(name, function)
